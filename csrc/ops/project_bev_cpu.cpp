// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns the cells of its range.
#include "common/allocate.h"
#include "common/tile.h"
#include "math/product.h"
#include "ops/project_bev.h"

namespace pred::PRED_ISA {
namespace {

// Copies of rows with whole panels of columns, the rest 0.
template <typename S>
struct Tile {
  using T = Compute<S>;
  int64_t in_stride, out_stride;
  S *in, *out, *interleaved[2];
  uintptr_t end;

  Tile(const ProjectArgs<S>& a, char* memory) {
    Arena arena(memory);
    in_stride = panel_columns<T>(a.inputs);
    out_stride = panel_columns<T>(a.outputs);
    in = arena.take<S>(kRowTile * in_stride);
    out = arena.take<S>(kRowTile * out_stride);
    interleaved[0] = arena.take<S>(kPair<S> > 1 ? kRowTile * out_stride : 0);
    interleaved[1] = arena.take<S>(kPair<S> > 1 ? kRowTile * in_stride : 0);
    end = arena.at;
  }
};

template <typename S>
static int64_t scratch_bytes(const ProjectArgs<S>& a) {
  return int64_t(Tile<S>(a, nullptr).end) + Arena::kAlignment;
}

// Returns whether any number is not 0.
template <typename S>
static bool read_rows(const S* __restrict from, int64_t columns, int64_t count, int64_t stride, S* __restrict to) {
  bool any = false;
  for (int64_t r = 0; r < count; ++r) {
    for (int64_t c = 0; c < columns; ++c) {
      to[r * stride + c] = from[r * columns + c];
      any |= !(widen(from[r * columns + c]) == Compute<S>(0));
    }
    for (int64_t c = columns; c < stride; ++c) narrow_to(to[r * stride + c], Compute<S>(0));
  }
  return any;
}

template <typename S>
static void write_rows(const S* __restrict from, int64_t stride, int64_t count, int64_t columns, S* __restrict to) {
  for (int64_t r = 0; r < count; ++r) {
    for (int64_t c = 0; c < columns; ++c) to[r * columns + c] = from[r * stride + c];
  }
}

template <typename S, typename T = Compute<S>>
static void multiply(const S* rows, int64_t row_stride, int64_t count, int64_t inputs, const S* packed, int64_t outputs,
                     int64_t stride, S* out) {
  constexpr int W = kWidth<T>;
  product(rows, row_stride, count, inputs, packed, outputs,
          [=](int64_t row, int64_t column, Vec<T, W> sum)
              __attribute__((always_inline)) { store_factors<W>(out + row * stride + column, sum); });
}

template <typename S>
static void forward(const ProjectArgs<S>& a, S* out, char* scratch, int64_t begin, int64_t end) {
  const Tile<S> tile(a, scratch);
  for (int64_t first = begin; first < end; first += kRowTile) {
    const int64_t count = end - first < kRowTile ? end - first : kRowTile;
    read_rows(a.rows + first * a.inputs, a.inputs, count, tile.in_stride, tile.in);
    multiply(tile.in, tile.in_stride, count, a.inputs, a.packed, a.outputs, tile.out_stride, tile.out);
    write_rows(tile.out, tile.out_stride, count, a.outputs, out + first * a.outputs);
  }
}

template <typename S>
static void backward(const ProjectArgs<S>& a, const ProjectGradients<S>& out, char* scratch, int64_t begin,
                     int64_t end) {
  const Tile<S> tile(a, scratch);
  for (int64_t first = begin; first < end; first += kRowTile) {
    const int64_t count = end - first < kRowTile ? end - first : kRowTile;
    // Most cells of a map are touched by no ray: their gradient is 0, and costs nothing more.
    const bool any = read_rows(a.grad + first * a.outputs, a.outputs, count, tile.out_stride, tile.out);
    if (any && out.weight) {
      read_rows(a.rows + first * a.inputs, a.inputs, count, tile.in_stride, tile.in);
      outer_product(interleave(tile.out, tile.out_stride, count, tile.interleaved[0]), tile.out_stride, a.outputs,
                    interleave(tile.in, tile.in_stride, count, tile.interleaved[1]), tile.in_stride, tile.in_stride,
                    count, out.weight, tile.in_stride);
    }
    if (!out.rows) continue;
    S* rows = out.rows + first * a.inputs;
    if (any) {
      multiply(tile.out, tile.out_stride, count, a.outputs, a.packed, a.inputs, tile.in_stride, tile.in);
      write_rows(tile.in, tile.in_stride, count, a.inputs, rows);
    } else {
      for (int64_t i = 0; i < count * a.inputs; ++i) narrow_to(rows[i], Compute<S>(0));
    }
  }
}

template <typename S>
constexpr ProjectKernels<S> project_kernels() {
  return {packed_size<S>, pack<S>, panel_columns<Compute<S>>, scratch_bytes<S>, forward<S>, backward<S>};
}

}  // namespace

const ProjectKernels<float> project_bev_f32 = project_kernels<float>();
const ProjectKernels<double> project_bev_f64 = project_kernels<double>();
const ProjectKernels<BFloat16> project_bev_bf16 = project_kernels<BFloat16>();

}  // namespace pred::PRED_ISA
