// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// A tile of output rows goes through the taps one by one: the rows that a tap reads are gathered side by side,
// multiplied, and added to the tile's sums, which stay in cache. One iteration owns its rows, or a tap's sums.
#include "common/allocate.h"
#include "common/tile.h"
#include "math/product.h"
#include "ops/sparse_conv.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
struct Tile {
  using T = Compute<S>;
  using F = Factor<S>;
  int64_t in_stride, out_stride;
  F *in, *out, *interleaved[2];
  T* sums;
  int32_t* rows;
  uintptr_t end;

  Tile(const SparseConvArgs<S>& a, char* memory) {
    Arena arena(memory);
    in_stride = panel_columns<T>(a.inputs);
    out_stride = panel_columns<T>(a.outputs);
    in = arena.take<F>(kSparseTile * in_stride);
    sums = arena.take<T>(kSparseTile * out_stride);
    rows = arena.take<int32_t>(kSparseTile);
    out = arena.take<F>(kRowTile * out_stride);
    interleaved[0] = arena.take<F>(kPair<F> > 1 ? kRowTile * out_stride : 0);
    interleaved[1] = arena.take<F>(kPair<F> > 1 ? kRowTile * in_stride : 0);
    end = arena.at;
    if (!memory) return;
    // Gathering leaves the columns that pad a row as they are.
    for (int64_t i = 0; i < kSparseTile * in_stride; ++i) narrow_to(in[i], T(0));
    for (int64_t i = 0; i < kRowTile * out_stride; ++i) narrow_to(out[i], T(0));
  }
};

template <typename S>
static int64_t scratch_bytes(const SparseConvArgs<S>& a) {
  return int64_t(Tile<S>(a, nullptr).end) + Arena::kAlignment;
}

template <typename S>
static int64_t factors_size(int64_t inputs, int64_t outputs) {
  return packed_size<Factor<S>>(inputs, outputs);
}

template <typename S>
static void pack_factors(const S* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns,
                         Compute<S>* scratch, Factor<S>* to) {
  for (int64_t k = 0; k < rows; ++k) {
    for (int64_t n = 0; n < columns; ++n) scratch[k * columns + n] = widen(from[k * row_stride + n * column_stride]);
  }
  pack<Factor<S>>(scratch, columns, 1, rows, columns, to);
}

template <typename S>
static inline void copy_row(const S* __restrict from, int64_t columns, Factor<S>* __restrict to) {
  if constexpr (std::is_same_v<S, Factor<S>>) {
    for (int64_t c = 0; c < columns; ++c) to[c] = from[c];
  } else {
    for (int64_t c = 0; c < columns; ++c) to[c] = widen(from[c]);
  }
}

template <typename S>
static void product_along_table(const SparseConvArgs<S>& a, S* out, char* scratch, int64_t begin, int64_t end) {
  using T = Compute<S>;
  constexpr int W = kWidth<T>;
  const Tile<S> tile(a, scratch);
  const int64_t stride = tile.out_stride;
  for (int64_t first = begin; first < end; first += kSparseTile) {
    const int64_t count = end - first < kSparseTile ? end - first : kSparseTile;
    for (int64_t r = 0; r < count; ++r) {
      for (int64_t c = 0; c < stride; ++c) {
        tile.sums[r * stride + c] = a.bias && c < a.outputs ? widen(a.bias[c]) : T(0);
      }
    }
    for (int64_t tap = 0; tap < a.taps; ++tap) {
      const int32_t* from = a.table + first * a.taps + tap;
      int64_t gathered = 0;
      for (int64_t r = 0; r < count; ++r) {
        const int64_t source = from[r * a.taps];
        if (source < 0) continue;
        tile.rows[gathered] = int32_t(r);
        copy_row(a.source + source * a.inputs, a.inputs, tile.in + gathered * tile.in_stride);
        ++gathered;
      }
      product(tile.in, tile.in_stride, gathered, a.inputs, a.packed + tap * a.packed_size, a.outputs,
              [&](int64_t row, int64_t column, Vec<T, W> sum) __attribute__((always_inline)) {
                T* to = tile.sums + tile.rows[row] * stride + column;
                store(to, load<W>(to) + sum);
              });
    }
    for (int64_t r = 0; r < count; ++r) {
      S* row = out + (first + r) * a.outputs;
      for (int64_t c = 0; c < a.outputs; ++c) row[c] = narrow<S>(tile.sums[r * stride + c]);
    }
  }
}

template <typename S>
static void weight_gradient(const SparseConvArgs<S>& a, int64_t tap, Compute<S>* sums, char* scratch, int64_t begin,
                            int64_t end) {
  const Tile<S> tile(a, scratch);
  int64_t gathered = 0;
  const auto add = [&] {
    outer_product(interleave(tile.out, tile.out_stride, gathered, tile.interleaved[0]), tile.out_stride, a.outputs,
                  interleave(tile.in, tile.in_stride, gathered, tile.interleaved[1]), tile.in_stride, tile.in_stride,
                  gathered, sums, tile.in_stride);
    gathered = 0;
  };
  for (int64_t row = begin; row < end; ++row) {
    const int64_t source = a.table[row * a.taps + tap];
    if (source < 0) continue;
    copy_row(a.source + source * a.inputs, a.inputs, tile.in + gathered * tile.in_stride);
    copy_row(a.grad + row * a.outputs, a.outputs, tile.out + gathered * tile.out_stride);
    if (++gathered == kRowTile) add();
  }
  if (gathered > 0) add();
}

static bool is_valid(const int32_t* table, int64_t rows, int64_t begin, int64_t end) {
  int32_t wrong = 0;
  for (int64_t i = begin; i < end; ++i) wrong |= int32_t(table[i] < -1) | int32_t(table[i] >= rows);
  return wrong == 0;
}

template <typename S>
constexpr SparseConvKernels<S> table() {
  return {factors_size<S>,    pack_factors<S>, panel_columns<Compute<S>>, scratch_bytes<S>, product_along_table<S>,
          weight_gradient<S>, is_valid};
}

}  // namespace

const SparseConvKernels<float> sparse_conv_f32 = table<float>();
const SparseConvKernels<double> sparse_conv_f64 = table<double>();
const SparseConvKernels<BFloat16> sparse_conv_bf16 = table<BFloat16>();
const SparseConvKernels<Float16> sparse_conv_f16 = table<Float16>();

}  // namespace pred::PRED_ISA
