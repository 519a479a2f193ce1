// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// decode_field: signed distance, class logits and the distance's gradient of a BEV-conditioned MLP, and all derivatives
// of them. docs/decoder.md derives the formulas. Per sample, with phi = softplus and l = 1 .. L hidden layers:
//   n    = (point - centre) / half_extent,   e = encoding(n)
//   z_1  = F(n) + W_1 e + b_1,               F: bilinear in the projected map
//   z_l  = W_l a_{l-1} + b_l,                a_l = phi(z_l),  s_l = phi'(z_l)
//   out  = W_o a_L + b_o                     row 0, times sdf_scale: the distance
//   g_L  = s_L * w,   g_{l-1} = s_{l-1} * (W_l^T g_l)         w = sdf_scale W_o[0]
//   grad = (J^T W_1^T g_1 + F'^T g_1) / half_extent           J = de/dn
// Backward, for cotangents o of out (column 0 times sdf_scale) and v of grad / half_extent:
//   y_1  = W_1 J v + F' v,   y_l = W_l (s_{l-1} * y_{l-1})    tangents of z
//   q_l  = g_l * y_l * beta (1 - s_l)
//   x_L  = q_L + s_L * (W_o^T o),   x_{l-1} = q_{l-1} + s_{l-1} * (W_l^T x_l)
//   dW_l = x_l a_{l-1}^T + g_l (s_{l-1} * y_{l-1})^T,   db_l = x_l
//   dW_1 = x_1 e^T + g_1 (J v)^T,   dW_o = o a_L^T, and in row 0 sdf_scale (s_L * y_L)^T,   db_o = o
//   the map gets x_1 along F and g_1 along F' v;  dn = J^T W_1^T x_1 + F'^T x_1 + (d/dn of y_1)^T g_1
//
// Rows of hidden width are stored as S; T = Compute<S>. Half precision rounds W_1 e less than the rest: it has the high
// frequencies, and its share of z is one of the largest. Both factors are split into a rounded part and what is left of
// it, whose products with the other rounded part are added.
#pragma once

#include <type_traits>

#include "common/isa.h"
#include "ops/sample_grid.h"

namespace pred {

constexpr int kMaxHidden = 15;

// Elements from one row of hidden width to the next, the same at every level: whole panels of math/product.h.
PRED_HOST_DEVICE int64_t field_stride(int64_t width) { return (width + 31) / 32 * 32; }

// Rows of the first matrix, and columns of the encoding's rows: W_1 e, or [W_1, W_1, W_1 - rounded W_1] [e, e - rounded
// e, e].
template <typename S>
constexpr int64_t kFieldParts = std::is_same_v<S, Compute<S>> ? 1 : 3;

template <typename S>
struct FieldArgs {
  using T = Compute<S>;
  SampleGridArgs<S, 2> map;  // [B, H, W, hidden]; map.channels is the width, map.num_samples N
  const T* points;           // [B, N, 3] metres
  T centre[3], half_extent[3];
  int64_t octaves;
  T beta, sdf_scale;
  bool tf32;                        // where kernels are launched
  int64_t num_hidden, num_outputs;  // outputs: 1, or 1 + K
  // Not where kernels are launched, which take the parameters as they are. Packed: up[l] is W_l^T, [inputs, width];
  // down[l] is W_l, [width, inputs]. Index num_hidden is the output layer.
  const S* first;  // up[0] in kFieldParts<S> parts
  const S* up[kMaxHidden + 1];
  const S* down[kMaxHidden + 1];
  const T* bias[kMaxHidden + 1];
  const T* sdf_row;  // [width] sdf_scale W_o[0], padded by zeros to the stride
};

// What the forward pass keeps: activations a_l [L, B N, stride], from which the slopes follow, and chain [L - 1, B N,
// stride], the g_l but for the last, where there is a gradient. Null where nothing is kept.
template <typename S>
struct FieldSaved {
  S *activation, *chain;
};

template <typename S>
struct FieldOutputs {
  Compute<S>*sdf, *semantics, *gradient;  // [B N], [B N, K] or null, [B N, 3] or null
};

template <typename S>
struct FieldCotangents {
  const Compute<S>*sdf, *semantics, *gradient;  // as above; null where absent
};

// Gradients; null where not wanted.
template <typename S>
struct FieldGradients {
  Compute<S>*
      parameters;  // one block's part: dW_l [width, columns], db_l [width] for each layer; launched, all of them
  S* along_map;    // [B N, width] x_1
  S* along_slope;  // [B N, width] g_1, with a cotangent of the gradient
  Compute<S>* directions;  // [B N, 2] v of the map's axes, with a cotangent of the gradient
  Compute<S>* points;      // [B N, 3]
};

#ifdef PRED_LAUNCH
// `parameters`: W_l [outputs, inputs], b_l [outputs] for each layer.
template <typename S>
struct FieldKernels {
  using T = Compute<S>;
  int64_t (*workspace_bytes)(const FieldArgs<S>&, int64_t num_samples, bool backward);
  void (*forward)(const FieldArgs<S>&, const T* parameters, const FieldSaved<S>&, const FieldOutputs<S>&,
                  char* workspace, int64_t num_samples);
  void (*backward)(const FieldArgs<S>&, const T* parameters, const FieldSaved<S>&, const FieldCotangents<S>&,
                   const FieldGradients<S>&, char* workspace, int64_t num_samples);
  // Of the samples in the map, [B N, 2], as sample_bev takes them.
  void (*positions)(const FieldArgs<S>&, T* grid, int64_t num_samples);
};
#else
template <typename S>
struct FieldKernels {
  using T = Compute<S>;
  int64_t (*packed_size)(int64_t rows, int64_t columns);
  void (*pack)(const T* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns, S* to);
  int64_t (*columns)(int64_t columns);  // that products write: whole panels
  int64_t (*scratch_bytes)(const FieldArgs<S>&, bool backward);
  // Ranges count samples over all maps, of which there are num_samples.
  void (*forward)(const FieldArgs<S>&, const FieldSaved<S>&, const FieldOutputs<S>&, char* scratch, int64_t begin,
                  int64_t end, int64_t num_samples);
  // Adds the range's part to gradients.parameters.
  void (*backward)(const FieldArgs<S>&, const FieldSaved<S>&, const FieldCotangents<S>&, const FieldGradients<S>&,
                   char* scratch, int64_t begin, int64_t end, int64_t num_samples);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(FieldKernels<float>, decode_field_f32)
PRED_DECLARE_KERNELS(FieldKernels<double>, decode_field_f64)
PRED_DECLARE_KERNELS(FieldKernels<BFloat16>, decode_field_bf16)
