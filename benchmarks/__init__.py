# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of the ops and of the rendering step; run them with ``python -m benchmarks``."""
