# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Models: encoder, field, renderer, and the pre-training model that joins them."""
