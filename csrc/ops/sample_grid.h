// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sample_bev and sample_volume: linear gather from a map with two or three axes, its gradient, and the gradient of
// that; and the gather that returns its derivative in the position too.
//
// With stencil weights w_k(grid), their slopes w_k,a = dw_k/dgrid_a, and corner rows p_k = map[cell_k] (0 outside):
//   forward            out[c]       = sum_k w_k p_k[c]
//   backward           grad_map     : grad[c] w_k is added to cell_k
//                      grad_grid_a  = sum_k w_k,a D_k,                    D_k = sum_c grad[c] p_k[c]
//   double backward,   grad_out[c]  = sum_k w_k U_k[c] + sum_k b_k p_k[c], U = grad_grad_map rows,
//   cotangents U, v                                                        b_k = sum_a v_a w_k,a
//                      grad_map     : grad[c] b_k is added to cell_k
//                      grad_grid_a  = sum_k w_k,a E_k + sum_{b != a} v_b sum_k w_k,ab D_k, E_k = sum_c grad[c] U_k[c]
//   with_grad          out[c]       = sum_k w_k p_k[c],   slopes_a[c] = sum_k w_k,a p_k[c]
//   its backward,      grad_map     : grad[c] w_k + sum_a G_a[c] w_k,a is added to cell_k; or, where G_a = v_a g,
//                                     grad[c] w_k + g[c] b_k
//   cotangents grad, G grad_grid_a  = sum_k w_k,a D_k + sum_{b != a} sum_k w_k,ab D_b,k, D_b,k = sum_c G_b[c] p_k[c]
//
// Maps are channels-last in memory: [B, H, W, C] or [B, D, H, W, C]. Rows are stored as S and computed as Compute<S>;
// positions and their gradients are Compute<S>.
#pragma once

#include "common/isa.h"
#include "math/half.h"
#include "math/linear.h"

namespace pred {

template <typename S, int Axes>
struct SampleGridArgs {
  using T = Compute<S>;
  const S* map;                   // [B, (D,) H, W, C]
  const T* grid;                  // [B, N, Axes], x first, in [-1, 1]
  const S* zeros;                 // [C], read in place of cells outside the map
  int64_t channels, num_samples;  // num_samples N per map
  int64_t size[Axes];             // W, H(, D)
  int64_t stride[Axes + 1];       // elements of the map between cells along x, y(, z), and between maps
  bool border, align_corners;
  const S* grad;            // [B, N, C] gradient of the values; with grad_slopes it may be null
  const S* grad_slopes;     // [B, N, Axes, C] gradient of the values' derivatives, or null
  const S* grad_along;      // [B, N, C] g, in place of grad_slopes, or null; v is grad_grad_grid
  const S* grad_grad_map;   // [B, (D,) H, W, C] or null
  const T* grad_grad_grid;  // [B, N, Axes] or null
};

// Samples that touch their map, sorted by their lower corner's cell and, within it, by their number. Bits of an
// item from the top: map, y + 1, (z + 1,) x + 1, sample number b * N + n.
struct SampleGridOrder {
  const uint64_t* items;
  int number_bits, size_bits[3];
};

// The cells that one task of the scatter owns: those of a map with y in [begin, end), for all x and z. Its items are
// those whose lower corner has y in [begin - 1, end).
template <typename S>
struct SampleGridBand {
  int64_t map, begin, end;
  int64_t first_item, last_item;
  Compute<S>* sums;  // [(D,) end - begin, W, C] scratch; null where the result itself can hold them
};

// Rows of gradients that one sample sends to its cells: that of the value, and with kRows = 1 + Axes those of the
// value's derivatives, with kRows = kAlong that of its derivative along a direction.
constexpr int kAlong = 2;

// The weights of a sample's value and, with kOuts = 1 + Axes, of the value's derivatives.
template <int kOuts, typename T, int Axes>
PRED_HOST_DEVICE void forward_weights(const LinearStencil<T, Axes>& s, T (&weight)[kOuts][1 << Axes]) {
  linear_weights(s, 0, weight[0]);
  for (int m = 1; m < kOuts; ++m) {
    linear_weights(s, 1 << (m - 1), weight[m]);
    if (weight[0][0] != weight[0][0]) {  // slopes do not depend on every coordinate, but must show that one is NaN
      for (T& w : weight[m]) w = weight[0][0];
    }
  }
}

// Ranges count samples over all maps (b * N + n).
template <typename S, int Axes>
struct SampleGridKernels {
  using T = Compute<S>;
  using Args = SampleGridArgs<S, Axes>;
  // slopes, [B, N, Axes, C], may be null.
  void (*forward)(const Args&, S* out, S* slopes, int64_t begin, int64_t end);
  int64_t (*pack)(const Args&, const SampleGridOrder&, uint64_t* items, int64_t begin, int64_t end);
  // along_direction: use b_k in place of w_k. grad_grid, where not null, gets the samples' grid gradients.
  void (*scatter_band)(const Args&, const SampleGridOrder&, const SampleGridBand<S>&, bool along_direction, S* grad_map,
                       T* grad_grid);
  void (*backward_grid)(const Args&, T* grad_grid, int64_t begin, int64_t end);
  // Either output may be null.
  void (*double_backward)(const Args&, S* grad_out, T* grad_grid, int64_t begin, int64_t end);
  // Launched, in place of pack and scatter_band: writes all of grad_map. The workspace has so many bytes.
  int64_t (*scatter_bytes)(const Args&, int64_t batch);
  void (*scatter)(const Args&, int64_t batch, bool along_direction, S* grad_map, char* workspace);
  // Launched: adds to grad_map without a workspace, in an order that is another every time. Null for half precision.
  void (*scatter_atomically)(const Args&, int64_t batch, bool along_direction, S* grad_map);
};

template <typename S>
using SampleBevKernels = SampleGridKernels<S, 2>;
template <typename S>
using SampleVolumeKernels = SampleGridKernels<S, 3>;

}  // namespace pred

PRED_DECLARE_KERNELS(SampleBevKernels<float>, sample_bev_f32)
PRED_DECLARE_KERNELS(SampleBevKernels<double>, sample_bev_f64)
PRED_DECLARE_KERNELS(SampleBevKernels<BFloat16>, sample_bev_bf16)
PRED_DECLARE_KERNELS(SampleBevKernels<Float16>, sample_bev_f16)
PRED_DECLARE_KERNELS(SampleVolumeKernels<float>, sample_volume_f32)
PRED_DECLARE_KERNELS(SampleVolumeKernels<double>, sample_volume_f64)
PRED_DECLARE_KERNELS(SampleVolumeKernels<BFloat16>, sample_volume_bf16)
PRED_DECLARE_KERNELS(SampleVolumeKernels<Float16>, sample_volume_f16)
