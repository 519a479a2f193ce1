// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// composite_rays: volume rendering of depth, opacity and channels from signed distances, and its gradient.
//
// With opacities alpha_i of math/pair_alpha.h and T_i = prod_{j<i} (1 - alpha_j):
//   forward   w_i = T_i alpha_i;  depth = sum w_i p_i, opacity = sum w_i, channels = sum w_i v_i
//   backward  A_i = dL/dw_i, from all outputs;  S_i = sum_{j>i} w_j A_j
//             T_i = sum_{j>=i} w_j + T_end, from the saved weights
//             H_i = -dL/dlog(1 - alpha_i) = T_{i+1} A_i - S_i where the distance falls from i to i + 1, else 0
//             dL/d(s d_i) = Phi(-s d_i) (H_i - H_{i-1})
// since log(1 - alpha_i) = log Phi(s d_{i+1}) - log Phi(s d_i). Nothing is divided, so opacities of 0 and 1 are exact.
// Where the distance falls on both sides of i, H_i - H_{i-1} = T_i (A_i - A_{i-1}) is free of cancellation.
#pragma once

#include "common/isa.h"
#include "math/pair_alpha.h"

namespace pred {

template <typename T>
struct CompositeRaysArgs {
  const T* sdf;     // [R, S]
  const T* t;       // [R, S]
  const T* values;  // [R, S, C] or null
  T inv_s;
  int64_t num_samples, channels;
  bool depth_mid, last_opaque;
};

template <typename T>
struct CompositeRaysOutputs {
  T* weights;    // [R, S]
  T* depth;      // [R]
  T* opacity;    // [R]
  T* values;     // [R, C] or null
  T* remaining;  // [R] transmittance behind the last sample
};

// What the backward pass takes from the forward pass.
template <typename T>
struct CompositeRaysSaved {
  const T* weights;    // [R, S]
  const T* remaining;  // [R]
};

// Gradients of the outputs; null where absent.
template <typename T>
struct CompositeRaysCotangents {
  const T* weights;  // [R, S]
  const T* depth;    // [R]
  const T* opacity;  // [R]
  const T* values;   // [R, C]
};

// Gradients of the inputs; null where not wanted.
template <typename T>
struct CompositeRaysGradients {
  T* sdf;              // [R, S]
  double* inv_s;       // [R], each ray's part
  T* t;                // [R, S]
  T* values;           // [R, S, C]
  bool stream_values;  // store them past the caches
};

// Ranges count rays.
template <typename T>
struct CompositeRaysKernels {
  int64_t (*scratch_size)(const CompositeRaysArgs<T>&);  // in elements, for one range
  void (*forward)(const CompositeRaysArgs<T>&, const CompositeRaysOutputs<T>&, T* scratch, int64_t begin, int64_t end);
  void (*backward)(const CompositeRaysArgs<T>&, const CompositeRaysSaved<T>&, const CompositeRaysCotangents<T>&,
                   const CompositeRaysGradients<T>&, T* scratch, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(CompositeRaysKernels<float>, composite_rays_f32)
PRED_DECLARE_KERNELS(CompositeRaysKernels<double>, composite_rays_f64)
