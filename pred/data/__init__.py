# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Frames, pseudo labels, masking, ray sampling and batches; NumPy up to the collate step."""
