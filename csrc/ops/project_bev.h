// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// project_bev: a linear map of a BEV map's channels, and its gradients. With W [h, C], for each cell:
//   out = W row,   grad_row = W^T grad_out,   grad_W = sum over cells of grad_out row^T
// Maps are channels-last in memory, rows of C or h numbers stored as S; W and its gradient are Compute<S>.
#pragma once

#include "common/isa.h"
#include "math/half.h"

namespace pred {

template <typename S>
struct ProjectArgs {
  int64_t inputs, outputs;  // C, h
  const S* rows;            // [cells, C]
  const S* grad;            // [cells, h], of the backward pass
  const S* packed;          // W^T forward, W backward; not where kernels are launched
  bool tf32;                // where kernels are launched
};

// Gradients; null where not wanted. The weight's, [h, columns(C)], is added to; launched, [h, C] is written.
template <typename S>
struct ProjectGradients {
  S* rows;
  Compute<S>* weight;
};

#ifdef PRED_LAUNCH
template <typename S>
struct ProjectKernels {
  using T = Compute<S>;
  int64_t (*workspace_bytes)(const ProjectArgs<S>&, int64_t cells);
  // weight: [h, C].
  void (*forward)(const ProjectArgs<S>&, const T* weight, S* out, char* workspace, int64_t cells);
  void (*backward)(const ProjectArgs<S>&, const T* weight, const ProjectGradients<S>&, char* workspace, int64_t cells);
};
#else
template <typename S>
struct ProjectKernels {
  using T = Compute<S>;
  int64_t (*packed_size)(int64_t rows, int64_t columns);
  void (*pack)(const T* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns, S* to);
  int64_t (*columns)(int64_t columns);  // whole panels
  int64_t (*scratch_bytes)(const ProjectArgs<S>&);
  // Ranges count cells.
  void (*forward)(const ProjectArgs<S>&, S* out, char* scratch, int64_t begin, int64_t end);
  void (*backward)(const ProjectArgs<S>&, const ProjectGradients<S>&, char* scratch, int64_t begin, int64_t end);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(ProjectKernels<float>, project_bev_f32)
PRED_DECLARE_KERNELS(ProjectKernels<double>, project_bev_f64)
PRED_DECLARE_KERNELS(ProjectKernels<BFloat16>, project_bev_bf16)
