# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks``: times the ops and the rendering step; see ``--help``."""

import sys

from benchmarks.allocator import enter_allocator

# First of all, since the C library reads its settings when the process starts.
enter_allocator("default" if "--default-allocator" in sys.argv else "raised")

from benchmarks.cli import main  # noqa: E402

main()
