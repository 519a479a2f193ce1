// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Matrix products with epilogues on the accumulators, on tensor cores: halves, and float32 as three products of its
// parts in TF32, which together have the accuracy of float32; or as one product of rounded factors, where TF32 is
// asked for. float64, and what a device has no tensor cores for, is multiplied and added one by one.
//
// A block owns a tile of kTileM x kTileN results, its warps pieces of it. Both factors go through shared memory in
// stages; the next ones are fetched while one is multiplied. Sums over k are made in one order.
#pragma once

#include <type_traits>

#include "common/pack.cuh"

namespace pred::PRED_ISA {
namespace {

constexpr int kTileM = 128, kTileN = 128, kProductThreads = 256, kStages = 3;
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
  // Padding keeps the rows (inner) and elements (outer) of a fragment in different banks.
  static constexpr int kRow = kOuter ? kTileM + 8 : kTileK<S> + kChunk<S>;
  static constexpr int kRows = kOuter ? kTileK<S> : kTileM;
  static constexpr int kChunksPerRow = kOuter ? kTileM / kChunk<S> : kTileK<S> / kChunk<S>;
  static constexpr int kChunks = kRows * kChunksPerRow;
  S x[kRows][kRow];

  // Element k of row (of results) i.
  __device__ S at(int i, int k) const { return kOuter ? x[k][i] : x[i][k]; }
};

// --- Tensor cores --------------------------------------------------------------------------------
// mma_...: d += a b for one piece, in the layout of the instructions: lane 4 g + t has d of rows g and g + 8, columns
// 2 t and 2 t + 1; the first of them d = a b. Terms of a sum lose what lies below the last bit of the largest, and the
// sum is rounded toward zero (Fasi et al., Numerical behavior of NVIDIA tensor cores, 2021). Volatile: all lanes take
// part, and so none may be moved to where only some of them come.
// load_matrices: four matrices of 8 x 8 pairs of bytes in shared memory, of which lane 8 i + r names row r of matrix i
// (16 bytes, aligned). Lane 4 g + t gets elements 2 t and 2 t + 1 of row g of each, or of column g of its transpose.
#if !defined(__CUDACC__)
constexpr bool kTensorCores = true;

inline float round_toward_zero(double x) {
  const float near = float(x);
  return __builtin_fabs(double(near)) > __builtin_fabs(x) ? __builtin_nextafterf(near, 0.0f) : near;
}

template <int kTerms>
inline float tensor_core_sum(const double (&term)[kTerms]) {
  double largest = 0, sum = 0, unit = 0;
  for (double x : term) largest = __builtin_fmax(largest, __builtin_fabs(x));
  if (largest > 0 && largest < __builtin_inf()) unit = __builtin_ldexp(1, __builtin_ilogb(largest) - 23);
  for (double x : term) sum += unit > 0 ? __builtin_trunc(x / unit) * unit : x;
  return round_toward_zero(sum);
}

// Emulated: the lanes give each other their fragments.
template <int kDepth, class Multiply>
inline void emulate_mma(float (&d)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1, const Multiply& multiply) {
  uint32_t all_a[4][kWarp], all_b[2][kWarp];
  for (int i = 0; i < 4; ++i) {
    const uint64_t* lanes = emulation::exchange(a[i]);
    for (int lane = 0; lane < kWarp; ++lane) all_a[i][lane] = uint32_t(lanes[lane]);
  }
  for (int i = 0; i < 2; ++i) {
    const uint64_t* lanes = emulation::exchange(i ? b1 : b0);
    for (int lane = 0; lane < kWarp; ++lane) all_b[i][lane] = uint32_t(lanes[lane]);
  }
  const int g = int(threadIdx.x % kWarp) / 4, t = int(threadIdx.x % kWarp) % 4;
  for (int i = 0; i < 4; ++i) {
    const int half = i / 2, column = 2 * t + i % 2;  // row g + 8 half
    double term[9] = {double(d[i])};
    for (int part = 0; part < 4; ++part) {
      term[1 + part] = multiply(all_a[half][4 * g + part], all_b[0][4 * column + part]);
      term[5 + part] = multiply(all_a[2 + half][4 * g + part], all_b[1][4 * column + part]);
    }
    d[i] = tensor_core_sum(term);
  }
}
template <typename S>
inline void mma_half(float (&d)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
  emulate_mma<16>(d, a, b0, b1, [](uint32_t x, uint32_t y) {
    return double(widen(S{uint16_t(x)})) * double(widen(S{uint16_t(y)})) +
           double(widen(S{uint16_t(x >> 16)})) * double(widen(S{uint16_t(y >> 16)}));
  });
}
template <bool kFirst>
inline void mma_tf32(float (&d)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
  for (int i = 0; i < 4 && kFirst; ++i) d[i] = 0;
  emulate_mma<8>(d, a, b0, b1, [](uint32_t x, uint32_t y) {
    return double(bits_as<float>(x & 0xffffe000u)) * double(bits_as<float>(y & 0xffffe000u));
  });
}
template <bool kTranspose>
inline void load_matrices(const void* row, uint32_t (&to)[4]) {
  const uint64_t* rows = emulation::exchange(emulation::to_bits(row));
  const int g = lane_number() / 4, t = lane_number() % 4;
  for (int i = 0; i < 4; ++i) {
    const auto element = [&](int r, int c) {
      return uint32_t(emulation::from_bits<const uint16_t*>(rows[8 * i + r])[c]);
    };
    to[i] =
        kTranspose ? element(2 * t, g) | element(2 * t + 1, g) << 16 : element(g, 2 * t) | element(g, 2 * t + 1) << 16;
  }
}
#elif !defined(__CUDA_ARCH__) || __CUDA_ARCH__ >= 800
constexpr bool kTensorCores = true;

template <typename S>
PRED_DEVICE_ONLY void mma_half(float (&d)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
  if constexpr (std::is_same_v<S, BFloat16>) {
    asm volatile(
        "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 "
        "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
        : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
  } else {
    asm volatile(
        "mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
        "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
        : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
  }
}
template <bool kFirst>
PRED_DEVICE_ONLY void mma_tf32(float (&d)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
  if constexpr (kFirst) {
    asm volatile(
        "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 "
        "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%10,%10,%10,%10};"
        : "=f"(d[0]), "=f"(d[1]), "=f"(d[2]), "=f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1), "f"(0.0f));
  } else {
    asm volatile(
        "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 "
        "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
        : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
  }
}
template <bool kTranspose>
PRED_DEVICE_ONLY void load_matrices(const void* row, uint32_t (&to)[4]) {
  const uint32_t address = uint32_t(__cvta_generic_to_shared(row));
  if constexpr (kTranspose) {
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
                 : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
                 : "r"(address)
                 : "memory");
  } else {
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
                 : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
                 : "r"(address)
                 : "memory");
  }
}
#else
constexpr bool kTensorCores = false;
template <typename S>
PRED_DEVICE_ONLY void mma_half(float (&)[4], const uint32_t (&)[4], uint32_t, uint32_t) {}
template <bool kFirst>
PRED_DEVICE_ONLY void mma_tf32(float (&)[4], const uint32_t (&)[4], uint32_t, uint32_t) {}
template <bool kTranspose>
PRED_DEVICE_ONLY void load_matrices(const void*, uint32_t (&)[4]) {}
#endif

// Of results [row, row + 16), k from `k` on over 32 bytes.
template <typename S, bool kOuter>
PRED_DEVICE_ONLY void load_left(const SharedTile<S, kOuter>& tile, int row, int k, uint32_t (&a)[4]) {
  const int lane = lane_number();
  if constexpr (!kOuter) {
    load_matrices<false>(&tile.x[row + lane % 16][k + lane / 16 * kChunk<S>], a);
  } else if constexpr (sizeof(S) == 2) {
    load_matrices<true>(&tile.x[k + lane % 8 + lane / 16 * 8][row + lane / 8 % 2 * 8], a);
  } else {
    for (int i = 0; i < 4; ++i) a[i] = bits_as<uint32_t>(tile.x[k + lane % 4 + i / 2 * 4][row + lane / 4 + i % 2 * 8]);
  }
}

// Of results [column, column + 16): two pieces of two each.
template <typename S, bool kOuter>
PRED_DEVICE_ONLY void load_right(const SharedTile<S, kOuter>& tile, int column, int k, uint32_t (&b)[4]) {
  const int lane = lane_number();
  if constexpr (!kOuter) {
    load_matrices<false>(&tile.x[column + lane % 8 + lane / 16 * 8][k + lane / 8 % 2 * kChunk<S>], b);
  } else if constexpr (sizeof(S) == 2) {
    load_matrices<true>(&tile.x[k + lane % 16][column + lane / 16 * 8], b);
  } else {
    for (int i = 0; i < 4; ++i)
      b[i] = bits_as<uint32_t>(tile.x[k + lane % 4 + i % 2 * 4][column + lane / 4 + i / 2 * 8]);
  }
}

// Numbers of 24 bits rounded to 11, which the instructions read, and with what is left of them: NaN where they are not
// finite, whatever the other part becomes.
PRED_DEVICE_ONLY void round_tf32(uint32_t (&x)[4]) {
#pragma unroll
  for (int i = 0; i < 4; ++i) x[i] = bits_as<float>(x[i]) == bits_as<float>(x[i]) ? x[i] + 0x1000u : x[i];
}
PRED_DEVICE_ONLY void split_tf32(uint32_t (&x)[4], uint32_t (&rest)[4]) {
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const uint32_t nearest = (x[i] + 0x1000u) & 0xffffe000u;
    rest[i] = bits_as<uint32_t>(bits_as<float>(x[i]) - bits_as<float>(nearest));
    x[i] = nearest;
  }
}

// One stage: sum += rows [row0, row0 + kWarpM) of `left` times rows [column0, column0 + kWarpN) of `right`; with
// factors of type float rounded, or exact.
template <bool kRounded, typename S, bool kOuter, typename T = Compute<S>>
PRED_DEVICE_ONLY void multiply_stage(const SharedTile<S, kOuter>& left, const SharedTile<S, kOuter>& right, int row0,
                                     int column0, T (&sum)[kPiecesM][kPiecesN][4]) {
  constexpr bool kSplit = std::is_same_v<S, float> && !kRounded;
  if constexpr (kTensorCores && !std::is_same_v<S, double>) {
#pragma unroll
    for (int k = 0; k < kTileK<S>; k += 2 * kChunk<S>) {
      uint32_t b[kPiecesN / 2][4], b_rest[kPiecesN / 2][4];
#pragma unroll
      for (int j = 0; j < kPiecesN / 2; ++j) {
        load_right(right, column0 + 16 * j, k, b[j]);
        if constexpr (kSplit) {
          split_tf32(b[j], b_rest[j]);
        } else if constexpr (std::is_same_v<S, float>) {
          round_tf32(b[j]);
        }
      }
#pragma unroll
      for (int i = 0; i < kPiecesM; ++i) {
        uint32_t a[4], a_rest[4];
        load_left(left, row0 + 16 * i, k, a);
        if constexpr (kSplit) {
          split_tf32(a, a_rest);
        } else if constexpr (std::is_same_v<S, float>) {
          round_tf32(a);
        }
#pragma unroll
        for (int pair = 0; pair < kPiecesN / 2; ++pair) {
          if constexpr (std::is_same_v<S, float>) {
            // From 0, and added up by ordinary sums: what the instructions round off stays a part of eight products.
            float part[2][4];
            if constexpr (kSplit) {
#pragma unroll
              for (int j = 0; j < 2; ++j) mma_tf32<true>(part[j], a_rest, b[pair][2 * j], b[pair][2 * j + 1]);
#pragma unroll
              for (int j = 0; j < 2; ++j) mma_tf32<false>(part[j], a, b_rest[pair][2 * j], b_rest[pair][2 * j + 1]);
            }
#pragma unroll
            for (int j = 0; j < 2; ++j) mma_tf32<!kSplit>(part[j], a, b[pair][2 * j], b[pair][2 * j + 1]);
#pragma unroll
            for (int e = 0; e < 8; ++e) sum[i][2 * pair + e / 4][e % 4] += part[e / 4][e % 4];
          } else {
#pragma unroll
            for (int j = 0; j < 2; ++j) mma_half<S>(sum[i][2 * pair + j], a, b[pair][2 * j], b[pair][2 * j + 1]);
          }
        }
      }
    }
  } else {
    const int g = lane_number() / 4, t = lane_number() % 4;
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
// The 16 bytes from row[column] on to shared memory, or zeros where nothing is there; in its own time, until
// wait_for_copies.
template <typename S>
PRED_DEVICE_ONLY void copy_chunk(S* to, const S* row, int64_t column, bool there) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(uint32_t(__cvta_generic_to_shared(to))),
               "l"(reinterpret_cast<uintptr_t>(row) + column * sizeof(S)), "r"(there ? 16 : 0)
               : "memory");
#else
  using Chunk = Pack<S, kChunk<S>>;
  *reinterpret_cast<Chunk*>(to) = there ? *reinterpret_cast<const Chunk*>(row + column) : Chunk{};
#endif
}

PRED_DEVICE_ONLY void commit_copies() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm volatile("cp.async.commit_group;" ::: "memory");
#endif
}

// All but the last `later` commits.
template <int later>
PRED_DEVICE_ONLY void wait_for_copies() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm volatile("cp.async.wait_group %0;" ::"n"(later) : "memory");
#endif
}

// Sizes of a product. Inner: results [m, n] = sum over k of left[m, k] right[n, k], over `segments` pairs of factors.
// Outer: results [m, n] = sum over rows k of left[k, m] right[k, n], where `splits` blocks share the rows of a
// segment. Rows hold whole chunks, of which those of k (inner), of m and n (outer) are read. Apart: each segment has
// results of its own, the epilogue's splits being segment * splits + split.
struct ProductSizes {
  int64_t m, n, k;
  int segments, splits;
  bool tf32, apart;
};

constexpr int kMostSparseSegments = 512;

// Columns of results that a lane has side by side. In an inner product the rows of `right` lie in shared memory in an
// order that gives each lane kColumns of its warp's kWarpN.
template <bool kOuter>
constexpr int kColumns = kOuter ? 2 : 2 * kPiecesN;

// Of the shared row i of `right`, the row among those of the tile: of each piece, two columns belong to a lane.
PRED_DEVICE_ONLY int right_row(int i) {
  const int piece = i / 8 % kPiecesN, lane = i / 2 % 4;
  return i / kWarpN * kWarpN + lane * kColumns<false> + 2 * piece + i % 2;
}

// Left and Right: const S* row(int64_t i, int segment), null for a row of zeros. Left::kSparse: most rows are, and
// segments for which all rows of a tile are, are left out, up to kMostSparseSegments of an inner product.
// Epilogue: at(column, split) gives what takes (row, values) of kColumns columns, of which those below n count. A
// thread asks once for all its rows.
template <typename S, bool kOuter, class Left, class Right, class Epilogue>
__global__ void __launch_bounds__(kProductThreads, std::is_same_v<S, double> ? 1 : 2)
    product_kernel(ProductSizes sizes, Left left, Right right, Epilogue epilogue) {
  using T = Compute<S>;
  using Tile = SharedTile<S, kOuter>;
  auto* const tiles = static_cast<Tile(*)[2]>(dynamic_shared());  // [kStages], one per factor
  const int64_t tiles_n = (sizes.n + kTileN - 1) / kTileN, tiles_m = (sizes.m + kTileM - 1) / kTileM;
  const int warp = int(threadIdx.x) / kWarp;
  __shared__ int used[Left::kSparse ? kMostSparseSegments : 1], num_used;
  const bool by_list = Left::kSparse && !sizes.apart && sizes.segments <= kMostSparseSegments;
  const int row0 = warp % (kTileM / kWarpM) * kWarpM, column0 = warp / (kTileM / kWarpM) * kWarpN;
  const int64_t tasks = tiles_m * tiles_n * sizes.splits * (sizes.apart ? sizes.segments : 1);
  for (int64_t task = blockIdx.x; task < tasks; task += gridDim.x) {
    const int part = int(task / (tiles_m * tiles_n)), split = part % sizes.splits;
    const int64_t tile = task % (tiles_m * tiles_n), first_m = tile / tiles_n * kTileM,
                  first_n = tile % tiles_n * kTileN;
    const int64_t first[2] = {first_m, first_n}, size[2] = {sizes.m, sizes.n};  // of `left` and of `right`
    const int64_t steps_all = (sizes.k + kTileK<S> - 1) / kTileK<S>;
    const int step0 = int(steps_all * split / sizes.splits), step1 = int(steps_all * (split + 1) / sizes.splits);
    if (by_list) {
      for (int segment = warp; segment < sizes.segments; segment += kProductThreads / kWarp) {
        bool any = false;
        for (int i = lane_number(); i < kTileM; i += kWarp) any |= left.row(first_m + i, segment) != nullptr;
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
    const int steps = (step1 - step0) * (sizes.apart ? 1 : by_list ? num_used : sizes.segments);
    // The next stage that is fetched: its place among the segments, and in `tiles`.
    int place = sizes.apart ? part / sizes.splits : 0, to_fill = 0;
    int next_step = step0;
    // The rows of this thread's chunks: in an inner product the same in all stages of a segment.
    constexpr int kCopies = Tile::kChunks / kProductThreads;
    static_assert(Tile::kChunks % kProductThreads == 0);
    const S* rows[2][kCopies];
    const auto find_rows = [&] {
      const int segment = by_list ? used[place] : place;
#pragma unroll
      for (int factor = 0; factor < 2; ++factor) {
#pragma unroll
        for (int copy = 0; copy < kCopies; ++copy) {
          const int i = (int(threadIdx.x) + copy * kProductThreads) / Tile::kChunksPerRow;
          const int64_t row = kOuter ? int64_t(next_step) * kTileK<S> + i : first[factor] + (factor ? right_row(i) : i);
          const bool there = row < (kOuter ? sizes.k : size[factor]);
          rows[factor][copy] = !there ? nullptr : factor ? right.row(row, segment) : left.row(row, segment);
        }
      }
    };
    const auto fetch = [&] {
      if (kOuter || (Left::kSparse && next_step == step0)) find_rows();
#pragma unroll
      for (int factor = 0; factor < 2; ++factor) {
#pragma unroll
        for (int copy = 0; copy < kCopies; ++copy) {
          const int chunk = int(threadIdx.x) + copy * kProductThreads;
          const int i = chunk / Tile::kChunksPerRow, c = chunk % Tile::kChunksPerRow * kChunk<S>;
          const int64_t column = (kOuter ? first[factor] : int64_t(next_step) * kTileK<S>)+c;
          const S* const row = rows[factor][copy];
          copy_chunk(&tiles[to_fill][factor].x[i][c], row, column, row && column < (kOuter ? size[factor] : sizes.k));
        }
      }
      to_fill = to_fill + 1 < kStages ? to_fill + 1 : 0;
      if (++next_step == step1) {
        next_step = step0;
        ++place;
      }
    };
    if (!kOuter && !Left::kSparse) find_rows();
    T sum[kPiecesM][kPiecesN][4] = {};
#pragma unroll
    for (int stage = 0; stage < kStages - 1; ++stage) {
      if (stage < steps) fetch();
      commit_copies();  // of nothing, too: the waiting below counts commits
    }
    int stage = 0;
    for (int step = 0; step < steps; ++step) {
      wait_for_copies<kStages - 2>();
      __syncthreads();  // this stage is there, and the one before has been read
      if (step + kStages - 1 < steps) fetch();
      commit_copies();
      if (row0 < sizes.m - first_m && column0 < sizes.n - first_n) {
        if (std::is_same_v<S, float> && sizes.tf32) {
          multiply_stage<true>(tiles[stage][0], tiles[stage][1], row0, column0, sum);
        } else {
          multiply_stage<false>(tiles[stage][0], tiles[stage][1], row0, column0, sum);
        }
      }
      stage = stage + 1 < kStages ? stage + 1 : 0;
    }
    const int rows_here = int(sizes.m - first_m < kTileM ? sizes.m - first_m : kTileM);
#pragma unroll
    for (int run = 0; run < 2 * kPiecesN / kColumns<kOuter>; ++run) {
      const int64_t column = first_n + column0 + 8 * run + lane_number() % 4 * kColumns<kOuter>;
      if (column >= sizes.n) continue;
      const auto results = epilogue.at(column, part);
#pragma unroll
      for (int i = 0; i < kPiecesM; ++i) {
#pragma unroll
        for (int half = 0; half < 2; ++half) {
          const int row = row0 + 16 * i + 8 * half + lane_number() / 4;
          if (row >= rows_here) continue;
          T value[kColumns<kOuter>];
#pragma unroll
          for (int v = 0; v < kColumns<kOuter>; ++v) value[v] = sum[i][run + v / 2][2 * half + v % 2];
          results(first_m + row, value);
        }
      }
    }
    __syncthreads();  // all have read the last stage and the list
  }
}

template <typename S, bool kOuter, class Left, class Right, class Epilogue>
void launch_product(const ProductSizes& sizes, const Left& left, const Right& right, const Epilogue& epilogue) {
  const int64_t tiles = (sizes.m + kTileM - 1) / kTileM * ((sizes.n + kTileN - 1) / kTileN) * sizes.splits *
                        (sizes.apart ? sizes.segments : 1);
  launch_blocks(product_kernel<S, kOuter, Left, Right, Epilogue>, tiles, kProductThreads,
                2 * kStages * int64_t(sizeof(SharedTile<S, kOuter>)), sizes, left, right, epilogue);
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
    const int64_t row = divide(i, stride), column = i - row * stride;
    narrow_to(to[i],
              column < columns ? Compute<S>(widen(from[row * row_stride + column * column_stride])) : Compute<S>(0));
  }
}

template <typename From, typename S>
void pack_rows(const From* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns,
               int64_t stride, S* to) {
  launch_threads(pack_kernel<From, S>, rows * stride, from, row_stride, column_stride, rows, columns, stride, to);
}

// Whether rows of so many columns consist of whole chunks.
template <typename S>
bool in_chunks(const S* rows, int64_t columns) {
  return columns % kChunk<S> == 0 && reinterpret_cast<uintptr_t>(rows) % 16 == 0;
}

// to[v] = value[v] for the first `count` of kColumns values, in whole chunks where rows hold such.
template <typename S>
PRED_DEVICE_ONLY void store_columns(S* to, bool chunks, int64_t count, const Compute<S> (&value)[kColumns<false>]) {
  constexpr int V = kChunk<S>;
#pragma unroll
  for (int first = 0; first < kColumns<false>; first += V) {
    Compute<S> part[V];
#pragma unroll
    for (int v = 0; v < V; ++v) part[v] = value[first + v];
    if (chunks) {
      if (first < count) store_pack<V>(to + first, part);
    } else {
#pragma unroll
      for (int v = 0; v < V; ++v) {
        if (first + v < count) narrow_to(to[first + v], part[v]);
      }
    }
  }
}

// Rows as they are, where products can read them, or copied to `space`.
template <typename S>
ProductRows<S> readable_rows(const S* rows, int64_t columns, int64_t count, S* space) {
  const int64_t stride = whole_chunks<S>(columns);
  if (in_chunks(rows, columns)) return {rows, columns, count};
  pack_rows(rows, columns, int64_t(1), count, columns, stride, space);
  return {space, stride, count};
}

// Adds to parts [splits, m, n], or sets them. One thread adds to each; atomically, so that it need not wait for what is
// there.
template <typename T>
struct AddToParts {
  T* parts;
  int64_t m, n;
  bool set;

  __device__ auto at(int64_t column, int split) const {
    return [this, column, split](int64_t row, const T(&value)[2]) {
      T* to = parts + (split * m + row) * n + column;
      put(to, value[0]);
      if (column + 1 < n) put(to + 1, value[1]);
    };
  }

  __device__ void put(T* to, T value) const {
    if (set)
      *to = value;
    else
      atomicAdd(to, value);
  }
};

// out[i] = the sum of parts[split, i] over splits, in order; in float64, as there may be many.
template <typename T>
__global__ void add_splits_kernel(const T* parts, int64_t count, int splits, T* out) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    double sum = 0;
    for (int split = 0; split < splits; ++split) sum += double(parts[split * count + i]);
    out[i] = T(sum);
  }
}

// Blocks that share the rows of each of `count` outer products: so many that the device is busy and each has some
// hundred rows, but no more than a running sum can take without losing digits, as long as there is memory for the
// parts.
inline int outer_splits(int64_t m, int64_t n, int64_t rows, int64_t count = 1) {
  constexpr int64_t kBlocks = 264, kLeastRows = 512,
                    kMostRows = 1024;  // two blocks per multiprocessor of a large device
  constexpr int64_t kPartsElements = int64_t(1) << 26;
  if (m == 0 || n == 0 || count == 0) return 1;
  const int64_t tiles = (m + kTileM - 1) / kTileM * ((n + kTileN - 1) / kTileN) * count;
  const int64_t busy = (kBlocks + tiles - 1) / tiles, most = (rows + kLeastRows - 1) / kLeastRows;
  const int64_t precise = (rows + kMostRows - 1) / kMostRows, fit = kPartsElements / (m * n * count);
  const int64_t least = precise < fit ? precise : fit, splits = busy < most ? busy : most;
  return int(splits > least ? splits : least > 1 ? least : 1);
}

}  // namespace
}  // namespace pred::PRED_ISA
