// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Matrix products with epilogues on the accumulators, on tensor cores: bfloat16, and float32 as three products of its
// parts in TF32, which together have the accuracy of float32. float64, and what a device has no tensor cores for, is
// multiplied and added one by one.
//
// A block owns a tile of kTileM x kTileN results, its warps pieces of it. Both factors go through shared memory in
// stages; the next stage is fetched while this one is multiplied. Sums over k are made in one order.
#pragma once

#include <type_traits>

#include "common/launch.cuh"
#include "math/half.h"

#ifdef __CUDACC__
#include <cuda_pipeline.h>
#endif

namespace pred::PRED_ISA {
namespace {

constexpr int kTileM = 128, kTileN = 128, kProductThreads = 256;
constexpr int kWarpM = 64, kWarpN = 32;  // results of a warp: 4 x 4 pieces of 16 x 8
constexpr int kPiecesM = kWarpM / 16, kPiecesN = kWarpN / 8;

// Elements of 16 bytes, which rows must be whole numbers of; k of a stage.
template <typename S>
constexpr int kChunk = 16 / int(sizeof(S));
template <typename S>
constexpr int kTileK = 64 / int(sizeof(S));

// Rows that a product reads: `data` + row * stride, where there are so many.
template <typename S>
struct ProductRows {
  static constexpr bool kSparse = false;
  const S* data;
  int64_t stride, rows;

  __device__ const S* row(int64_t i, int) const { return i < rows ? data + i * stride : nullptr; }
};

// A shared tile: rows of a factor side by side. Inner: [128][kTileK], k along the row. Outer: [kTileK][128].
template <typename S, bool kOuter>
struct alignas(16) SharedTile {
  // Padding keeps the lanes of a fragment in different banks.
  static constexpr int kRow = kOuter ? kTileM + kChunk<S> : kTileK<S> + kChunk<S>;
  static constexpr int kRows = kOuter ? kTileK<S> : kTileM;
  static constexpr int kChunksPerRow = kOuter ? kTileM / kChunk<S> : kTileK<S> / kChunk<S>;
  static constexpr int kChunks = kRows * kChunksPerRow;
  S x[kRows][kRow];

  // Element k of row (of results) i.
  __device__ S at(int i, int k) const { return kOuter ? x[k][i] : x[i][k]; }
};

// --- Tensor cores --------------------------------------------------------------------------------
// d += a b for one piece, in the layout of the instructions: lane 4 g + t has d of rows g and g + 8, columns 2 t and
// 2 t + 1.
#if !defined(__CUDACC__)
constexpr bool kTensorCores = true;

// Emulated: the lanes give each other their fragments.
template <int kDepth, class Multiply>
inline void emulate_mma(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2], const Multiply& multiply) {
  uint32_t all_a[4][kWarp], all_b[2][kWarp];
  for (int i = 0; i < 4; ++i) {
    const uint64_t* lanes = emulation::exchange(a[i]);
    for (int lane = 0; lane < kWarp; ++lane) all_a[i][lane] = uint32_t(lanes[lane]);
  }
  for (int i = 0; i < 2; ++i) {
    const uint64_t* lanes = emulation::exchange(b[i]);
    for (int lane = 0; lane < kWarp; ++lane) all_b[i][lane] = uint32_t(lanes[lane]);
  }
  const int g = int(threadIdx.x % kWarp) / 4, t = int(threadIdx.x % kWarp) % 4;
  for (int i = 0; i < 4; ++i) {
    const int half = i / 2, column = 2 * t + i % 2;  // row g + 8 half
    for (int part = 0; part < 4; ++part) {
      d[i] += multiply(all_a[half][4 * g + part], all_b[0][4 * column + part]);
      d[i] += multiply(all_a[2 + half][4 * g + part], all_b[1][4 * column + part]);
    }
  }
}
inline void mma_bfloat16(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  emulate_mma<16>(d, a, b, [](uint32_t x, uint32_t y) {
    return widen_bfloat16<float>(x & 0xffffu) * widen_bfloat16<float>(y & 0xffffu) +
           bits_as<float>(x & 0xffff0000u) * bits_as<float>(y & 0xffff0000u);
  });
}
inline void mma_tf32(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  emulate_mma<8>(d, a, b, [](uint32_t x, uint32_t y) {
    return bits_as<float>(x & 0xffffe000u) * bits_as<float>(y & 0xffffe000u);
  });
}
#elif !defined(__CUDA_ARCH__) || __CUDA_ARCH__ >= 800
constexpr bool kTensorCores = true;

PRED_DEVICE_ONLY void mma_bfloat16(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}
PRED_DEVICE_ONLY void mma_tf32(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}
#else
constexpr bool kTensorCores = false;
PRED_DEVICE_ONLY void mma_bfloat16(float (&)[4], const uint32_t (&)[4], const uint32_t (&)[2]) {}
PRED_DEVICE_ONLY void mma_tf32(float (&)[4], const uint32_t (&)[4], const uint32_t (&)[2]) {}
#endif

// The nearest number of 11 bits.
PRED_DEVICE_ONLY float round_tf32(float x) {
  return x == x ? bits_as<float>((bits_as<uint32_t>(x) + 0x1000u) & 0xffffe000u) : x;
}

template <int N>
struct SplitFragment {
  uint32_t high[N], low[N];

  __device__ void set(int i, float x) {
    const float rounded = round_tf32(x);
    high[i] = bits_as<uint32_t>(rounded);
    low[i] = bits_as<uint32_t>(x == rounded ? 0.0f : round_tf32(x - rounded));  // infinity has no rest
  }
};

template <bool kOuter>
PRED_DEVICE_ONLY uint32_t pair_of(const SharedTile<BFloat16, kOuter>& tile, int i, int k) {
  return uint32_t(tile.at(i, k).bits) | uint32_t(tile.at(i, k + 1).bits) << 16;
}

// One stage: sum += rows [row0, row0 + kWarpM) of `left` times rows [column0, column0 + kWarpN) of `right`.
template <typename S, bool kOuter, typename T = Compute<S>>
PRED_DEVICE_ONLY void multiply_stage(const SharedTile<S, kOuter>& left, const SharedTile<S, kOuter>& right, int row0,
                                     int column0, T (&sum)[kPiecesM][kPiecesN][4]) {
  const int g = lane_number() / 4, t = lane_number() % 4;
  if constexpr (kTensorCores && std::is_same_v<S, BFloat16>) {
#pragma unroll
    for (int k = 0; k < kTileK<S>; k += 16) {
      uint32_t b[kPiecesN][2];
#pragma unroll
      for (int j = 0; j < kPiecesN; ++j) {
        b[j][0] = pair_of(right, column0 + 8 * j + g, k + 2 * t);
        b[j][1] = pair_of(right, column0 + 8 * j + g, k + 2 * t + 8);
      }
#pragma unroll
      for (int i = 0; i < kPiecesM; ++i) {
        const int row = row0 + 16 * i + g;
        const uint32_t a[4] = {pair_of(left, row, k + 2 * t), pair_of(left, row + 8, k + 2 * t),
                               pair_of(left, row, k + 2 * t + 8), pair_of(left, row + 8, k + 2 * t + 8)};
#pragma unroll
        for (int j = 0; j < kPiecesN; ++j) mma_bfloat16(sum[i][j], a, b[j]);
      }
    }
  } else if constexpr (kTensorCores && std::is_same_v<S, float>) {
#pragma unroll
    for (int k = 0; k < kTileK<S>; k += 8) {
      SplitFragment<2> b[kPiecesN];
#pragma unroll
      for (int j = 0; j < kPiecesN; ++j) {
        b[j].set(0, right.at(column0 + 8 * j + g, k + t));
        b[j].set(1, right.at(column0 + 8 * j + g, k + t + 4));
      }
#pragma unroll
      for (int i = 0; i < kPiecesM; ++i) {
        const int row = row0 + 16 * i + g;
        SplitFragment<4> a;
        a.set(0, left.at(row, k + t));
        a.set(1, left.at(row + 8, k + t));
        a.set(2, left.at(row, k + t + 4));
        a.set(3, left.at(row + 8, k + t + 4));
#pragma unroll
        for (int j = 0; j < kPiecesN; ++j) {
          mma_tf32(sum[i][j], a.low, b[j].high);
          mma_tf32(sum[i][j], a.high, b[j].low);
          mma_tf32(sum[i][j], a.high, b[j].high);
        }
      }
    }
  } else {
    for (int k = 0; k < kTileK<S>; ++k) {
      T b[kPiecesN][2];
#pragma unroll
      for (int j = 0; j < kPiecesN; ++j) {
        for (int c = 0; c < 2; ++c) b[j][c] = widen(right.at(column0 + 8 * j + 2 * t + c, k));
      }
#pragma unroll
      for (int i = 0; i < kPiecesM; ++i) {
        const T upper = widen(left.at(row0 + 16 * i + g, k)), lower = widen(left.at(row0 + 16 * i + g + 8, k));
#pragma unroll
        for (int j = 0; j < kPiecesN; ++j) {
          for (int c = 0; c < 2; ++c) {
            sum[i][j][c] += upper * b[j][c];
            sum[i][j][2 + c] += lower * b[j][c];
          }
        }
      }
    }
  }
}

// --- Blocks --------------------------------------------------------------------------------------
// 16 bytes to shared memory, or zeros; in its own time, until wait_for_copies.
PRED_DEVICE_ONLY void copy_chunk(void* to, const void* from) {
#ifdef __CUDACC__
  if (from) {
    __pipeline_memcpy_async(to, from, 16);
  } else {
    *static_cast<uint4*>(to) = uint4{0, 0, 0, 0};
  }
#else
  if (from)
    memcpy(to, from, 16);
  else
    memset(to, 0, 16);
#endif
}

PRED_DEVICE_ONLY void commit_copies() {
#ifdef __CUDACC__
  __pipeline_commit();
#endif
}

// All but the last `later` commits.
template <int later>
PRED_DEVICE_ONLY void wait_for_copies() {
#ifdef __CUDACC__
  __pipeline_wait_prior(later);
#endif
}

// Sizes of a product. Inner: results [m, n] = sum over k of left[m, k] right[n, k], over `segments` pairs of factors.
// Outer: results [m, n] = sum over rows k of left[k, m] right[k, n], where `splits` blocks share the rows of a
// segment. Rows hold whole chunks, of which those of k (inner), of m and n (outer) are read.
struct ProductSizes {
  int64_t m, n, k;
  int segments, splits;
};

constexpr int kMostSparseSegments = 512;

// Left and Right: const S* row(int64_t i, int segment), null for a row of zeros. Left::kSparse: most rows are, and
// segments for which all rows of a tile are, are left out, up to kMostSparseSegments of an inner product. The epilogue
// gets (row, column, split, value, value of the next column), for rows below m and columns below n, from one thread
// each.
template <typename S, bool kOuter, class Left, class Right, class Epilogue>
__global__ void __launch_bounds__(kProductThreads)
    product_kernel(ProductSizes sizes, Left left, Right right, Epilogue epilogue) {
  using T = Compute<S>;
  using Tile = SharedTile<S, kOuter>;
  __shared__ Tile tiles[2][2];  // stage, factor
  const int64_t tiles_n = (sizes.n + kTileN - 1) / kTileN, tiles_m = (sizes.m + kTileM - 1) / kTileM;
  const int warp = int(threadIdx.x) / kWarp;
  __shared__ int used[Left::kSparse ? kMostSparseSegments : 1], num_used;
  const bool by_list = Left::kSparse && sizes.segments <= kMostSparseSegments;
  const int row0 = warp % (kTileM / kWarpM) * kWarpM, column0 = warp / (kTileM / kWarpM) * kWarpN;
  for (int64_t task = blockIdx.x; task < tiles_m * tiles_n * sizes.splits; task += gridDim.x) {
    const int split = int(task / (tiles_m * tiles_n));
    const int64_t tile = task % (tiles_m * tiles_n), first_m = tile / tiles_n * kTileM,
                  first_n = tile % tiles_n * kTileN;
    const int64_t steps_all = (sizes.k + kTileK<S> - 1) / kTileK<S>;
    const int64_t step0 = steps_all * split / sizes.splits, step1 = steps_all * (split + 1) / sizes.splits;
    if (by_list) {
      for (int segment = warp; segment < sizes.segments; segment += kProductThreads / kWarp) {
        bool any = false;
        for (int i = lane_number(); i < kTileM; i += kWarp) any = any || left.row(first_m + i, segment);
        any = __any_sync(kWholeWarp, any);
        if (lane_number() == 0) used[segment] = any;
      }
      __syncthreads();
      if (threadIdx.x == 0) {
        num_used = 0;
        for (int segment = 0; segment < sizes.segments; ++segment) {
          if (used[segment]) used[num_used++] = segment;
        }
      }
      __syncthreads();
    }
    const int64_t steps = (step1 - step0) * (by_list ? num_used : sizes.segments);
    const auto fetch = [&](int64_t step) {
      const int place = int(step / (step1 - step0)), segment = by_list ? used[place] : place;
      const int64_t k0 = (step0 + step % (step1 - step0)) * kTileK<S>;
#pragma unroll
      for (int factor = 0; factor < 2; ++factor) {
        Tile& to = tiles[step % 2][factor];
        const int64_t first = factor ? first_n : first_m, size = factor ? sizes.n : sizes.m;
#pragma unroll
        for (int chunk = int(threadIdx.x); chunk < Tile::kChunks; chunk += kProductThreads) {
          const int i = chunk / Tile::kChunksPerRow, c = chunk % Tile::kChunksPerRow * kChunk<S>;
          const int64_t row = kOuter ? k0 + i : first + i, column = kOuter ? first + c : k0 + c;
          const bool there = row < (kOuter ? sizes.k : size) && column < (kOuter ? size : sizes.k);
          const S* from = !there ? nullptr : factor ? right.row(row, segment) : left.row(row, segment);
          copy_chunk(&to.x[i][c], from ? from + column : nullptr);
        }
      }
      commit_copies();
    };
    T sum[kPiecesM][kPiecesN][4] = {};
    if (steps > 0) fetch(0);
    for (int64_t step = 0; step < steps; ++step) {
      if (step + 1 < steps) {
        fetch(step + 1);
        wait_for_copies<1>();
      } else {
        wait_for_copies<0>();
      }
      __syncthreads();
      multiply_stage<S, kOuter>(tiles[step % 2][0], tiles[step % 2][1], row0, column0, sum);
      __syncthreads();
    }
    const int64_t row = first_m + row0 + lane_number() / 4, column = first_n + column0 + lane_number() % 4 * 2;
#pragma unroll
    for (int i = 0; i < kPiecesM; ++i) {
#pragma unroll
      for (int j = 0; j < kPiecesN; ++j) {
        for (int half = 0; half < 2; ++half) {
          const int64_t r = row + 16 * i + 8 * half, c = column + 8 * j;
          if (r < sizes.m && c < sizes.n) epilogue(r, c, split, sum[i][j][2 * half], sum[i][j][2 * half + 1]);
        }
      }
    }
    if (by_list) __syncthreads();  // all have read the list
  }
}

template <typename S, bool kOuter, class Left, class Right, class Epilogue>
void launch_product(const ProductSizes& sizes, const Left& left, const Right& right, const Epilogue& epilogue) {
  const int64_t tiles = (sizes.m + kTileM - 1) / kTileM * ((sizes.n + kTileN - 1) / kTileN) * sizes.splits;
  launch_blocks(product_kernel<S, kOuter, Left, Right, Epilogue>, tiles, kProductThreads, 0, sizes, left, right,
                epilogue);
}

// --- Around products -----------------------------------------------------------------------------
template <typename S>
int64_t whole_chunks(int64_t columns) {
  return (columns + kChunk<S> - 1) / kChunk<S> * kChunk<S>;
}

// to[row, column] = from[row row_stride + column column_stride], rounded, and 0 in columns that fill up a row.
template <typename From, typename S>
__global__ void pack_kernel(const From* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns,
                            int64_t stride, S* to) {
  for (int64_t i = first_thread(); i < rows * stride; i += thread_stride()) {
    const int64_t row = i / stride, column = i - row * stride;
    narrow_to(to[i],
              column < columns ? Compute<S>(widen(from[row * row_stride + column * column_stride])) : Compute<S>(0));
  }
}

template <typename From, typename S>
void pack_rows(const From* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns,
               int64_t stride, S* to) {
  launch_threads(pack_kernel<From, S>, rows * stride, from, row_stride, column_stride, rows, columns, stride, to);
}

// Rows as they are, where products can read them, or copied to `space`.
template <typename S>
ProductRows<S> readable_rows(const S* rows, int64_t columns, int64_t count, S* space) {
  const int64_t stride = whole_chunks<S>(columns);
  if (stride == columns && reinterpret_cast<uintptr_t>(rows) % 16 == 0) return {rows, columns, count};
  pack_rows(rows, columns, int64_t(1), count, columns, stride, space);
  return {space, stride, count};
}

// Adds to parts [splits, m, n], or sets them.
template <typename T>
struct AddToParts {
  T* parts;
  int64_t m, n;
  bool set;

  __device__ void operator()(int64_t row, int64_t column, int split, T value, T next) const {
    T* to = parts + (split * m + row) * n + column;
    to[0] = set ? value : to[0] + value;
    if (column + 1 < n) to[1] = set ? next : to[1] + next;
  }
};

// out[i] = the sum of parts[split, i] over splits, in order.
template <typename T>
__global__ void add_splits_kernel(const T* parts, int64_t count, int splits, T* out) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    T sum = T(0);
    for (int split = 0; split < splits; ++split) sum += parts[split * count + i];
    out[i] = sum;
  }
}

// Blocks that share the rows of an outer product, so that each has some hundred rows and the device is busy.
inline int outer_splits(int64_t m, int64_t n, int64_t rows) {
  constexpr int64_t kBlocks = 264, kLeastRows = 512;  // two per multiprocessor of a large device
  if (m == 0 || n == 0) return 1;
  const int64_t tiles = (m + kTileM - 1) / kTileM * ((n + kTileN - 1) / kTileN);
  const int64_t wanted = (kBlocks + tiles - 1) / tiles, most = (rows + kLeastRows - 1) / kLeastRows;
  return int(wanted < most ? wanted : most < 1 ? 1 : most);
}

}  // namespace
}  // namespace pred::PRED_ISA
