// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Functions that run on CPU and GPU. Internal linkage keeps the instruction-set levels apart.
#pragma once

#include <stdint.h>

#ifdef __CUDACC__
#define PRED_HOST_DEVICE static inline __host__ __device__
#else
#define PRED_HOST_DEVICE static inline
#endif
