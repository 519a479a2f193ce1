// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sample_bev: bilinear gather from a BEV map, its gradient, and the gradient of that.
//
// With stencil weights w_k(grid) and corner rows p_k = bev[cell_k] (0 outside the map):
//   forward            out[c]       = sum_k w_k p_k[c]
//   backward           grad_bev     : grad[c] w_k is added to cell_k
//                      grad_grid    = d/dgrid sum_k w_k D_k,              D_k = sum_c grad[c] p_k[c]
//   double backward,   grad_out[c]  = sum_k w_k U_k[c] + sum_k b_k p_k[c], U = grad_grad_bev rows,
//   cotangents U, v                                                        b_k = v . dw_k/dgrid
//                      grad_bev     : grad[c] b_k is added to cell_k
//                      grad_grid    = d/dgrid (sum_k w_k E_k + sum_k b_k D_k), E_k = sum_c grad[c] U_k[c]
//
// Maps are channels-last in memory: [B, H, W, C].
#pragma once

#include "common/isa.h"
#include "math/bilinear.h"

namespace pred {

template <typename T>
struct SampleBevArgs {
  const T* bev;                                  // [B, H, W, C]
  const T* grid;                                 // [B, N, 2], x then y in [-1, 1]
  int64_t channels, height, width, num_samples;  // num_samples N per map
  bool border, align_corners;
  const T* grad;            // [B, N, C] gradient of the output
  const T* grad_grad_bev;   // [B, H, W, C] or null
  const T* grad_grad_grid;  // [B, N, 2] or null
};

// Samples that touch their map, sorted by their lower corner's cell and, within it, by their number. Bits of an
// item from the top: map, row + 1, column + 1, sample number b * N + n.
struct SampleBevOrder {
  const uint64_t* items;
  int number_bits, column_bits, row_bits;
};

// Map rows that one task of the scatter owns, y in [begin, end), and the items whose lower corner lies in rows
// [begin - 1, end - 1). Their share of row begin - 1, which the band before owns, goes to `row_before`.
template <typename T>
struct SampleBevBand {
  int64_t map, begin, end;
  int64_t first_item, last_item;
  T* row_before;  // [W, C]
};

// Ranges count samples over all maps (b * N + n).
template <typename T>
struct SampleBevKernels {
  void (*forward)(const SampleBevArgs<T>&, T* out, int64_t begin, int64_t end);
  int64_t (*pack)(const SampleBevArgs<T>&, const SampleBevOrder&, uint64_t* items, int64_t begin, int64_t end);
  // along_direction: use b_k in place of w_k. grad_grid, where not null, gets the samples' grid gradients.
  void (*scatter_band)(const SampleBevArgs<T>&, const SampleBevOrder&, const SampleBevBand<T>&, bool along_direction,
                       T* grad_bev, T* grad_grid);
  void (*backward_grid)(const SampleBevArgs<T>&, T* grad_grid, int64_t begin, int64_t end);
  // Either output may be null.
  void (*double_backward)(const SampleBevArgs<T>&, T* grad_out, T* grad_grid, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(SampleBevKernels<float>, sample_bev_f32)
PRED_DECLARE_KERNELS(SampleBevKernels<double>, sample_bev_f64)
