// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What composite_rays and composite_alpha share: rays of equal or of different lengths, arguments, results, tables.
//
// Both weigh the samples of a ray by w_i = T_i alpha_i, T_i = prod_{j<i} passed_j, and sum
//   depth = sum w_i p_i,  opacity = sum w_i,  channels = sum w_i v_i
// with p_i the t of sample i, or the middle of t_i and t_{i+1} (of the last sample always its own t). Backward,
//   A_i = dL/dw_i = grad_weights_i + grad_depth p_i + grad_opacity + sum_c grad_channels_c v_ic
//   dL/dv_i = w_i grad_channels,  dL/dp_i = w_i grad_depth
// They differ in where alpha comes from and in what A means for that.
//
// S is the storage type of values and of what is rendered from them, T = Compute<S> the type of everything else.
#pragma once

#include "common/isa.h"
#include "math/half.h"
#include "ops/ray_rows.h"

namespace pred {

template <typename S>
struct CompositeArgs {
  using Storage = S;
  RayRows rows;
  const Compute<S>* source;  // [P], sdf or alpha
  const Compute<S>* t;       // [P] or null
  const S* values;           // [P, C] or null
  int64_t channels;
  bool depth_mid;
};

template <typename S>
struct CompositeOutputs {
  Compute<S>* weights;    // [P]
  Compute<S>* depth;      // [R], or null without t
  Compute<S>* opacity;    // [R]
  S* values;              // [R, C], or null without values
  Compute<S>* remaining;  // [R] transmittance behind the last sample, or null
};

// What a backward pass takes from the forward pass.
template <typename T>
struct CompositeSaved {
  const T* weights;    // [P]
  const T* remaining;  // [R]
};

// Gradients of the outputs; null where absent.
template <typename S>
struct CompositeCotangents {
  const Compute<S>* weights;  // [P]
  const Compute<S>* depth;    // [R]
  const Compute<S>* opacity;  // [R]
  const S* values;            // [R, C]
};

// Gradients of the inputs; null where not wanted.
template <typename S>
struct CompositeGradients {
  Compute<S>* source;  // [P]
  double* inv_s;       // [R], each ray's part
  Compute<S>* t;       // [P]
  S* values;           // [P, C]
  bool stream_values;  // store them past the caches
};

// Ranges count rays. Scratch is for one range, in elements, where no ray has more than `longest` samples.
template <class Args>
struct CompositeKernels {
  using S = typename Args::Storage;
  using T = Compute<S>;
  int64_t (*scratch_size)(const Args&, int64_t longest);
  void (*forward)(const Args&, const CompositeOutputs<S>&, T* scratch, int64_t longest, int64_t begin, int64_t end);
  void (*backward)(const Args&, const CompositeSaved<T>&, const CompositeCotangents<S>&, const CompositeGradients<S>&,
                   T* scratch, int64_t longest, int64_t begin, int64_t end);
};

}  // namespace pred
