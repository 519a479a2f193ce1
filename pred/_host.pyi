# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
from numpy.typing import NDArray

def place_sweep(
    points: NDArray[np.float32], transform: NDArray[np.float64], ego_box: NDArray[np.float64], lag_s: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]: ...
