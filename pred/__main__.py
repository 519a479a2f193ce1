# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m pred` is the same as `pred`."""

import sys

from pred.cli import main

if __name__ == "__main__":  # loader processes may import this module
    sys.exit(main())
