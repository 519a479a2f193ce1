# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""PRED: pre-training LiDAR encoders by semantic rendering."""

__version__ = "0.1.0"
