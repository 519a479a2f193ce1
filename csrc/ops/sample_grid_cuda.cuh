// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CUDA kernels of sample_bev and sample_volume, which instantiate sample_grid_kernels<S, Axes>.
//
// Gathers: a group of lanes, as many as a row of channels has pieces of 16 bytes (1 to 32), owns one sample, a lane its
// share of the channels.
// Scatter: samples are sorted by their lower corner's cell, so that those of one cell stand side by side. A warp owns
// one cell of the map and adds up what up to 4 (8) of these runs send to it, in their order: no two threads write one
// address, and the sums have the same bits every time. Rays start in one place, so runs can be long there: pieces of
// kPiece items, at multiples of it, that lie within one run are added up beforehand, each by a warp of its own.
// Scatter with atomics, where the order of a sum may be another every time: a group takes as many neighbouring samples
// as it has lanes and adds them up in registers as long as they lie in one cell, as those along a ray do; then its
// lanes add to the map.
#pragma once

#include "common/bits.h"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/sample_grid_rows.cuh"

namespace pred::PRED_ISA {
namespace {

template <typename S, int Axes>
PRED_DEVICE_ONLY LinearStencil<Compute<S>, Axes> stencil(const SampleGridArgs<S, Axes>& a, int64_t sample) {
  return linear_stencil<Axes>(a.grid + sample * Axes, a.size, a.border, a.align_corners);
}

// The row of gradients that a sample sends to its cells: m = 0, that of the value; others, those of the value's
// derivatives; with kRows = kAlong that of its derivative along a direction. Null where there is none.
template <int kRows, typename S, int Axes>
PRED_DEVICE_ONLY const S* gradient_row(const SampleGridArgs<S, Axes>& a, int64_t sample, int m) {
  if (m == 0) return a.grad ? a.grad + sample * a.channels : nullptr;
  if (kRows == kAlong) return a.grad_along + sample * a.channels;
  return a.grad_slopes + (sample * Axes + m - 1) * a.channels;
}

// The cell of one sample: where its lower corner lies in the maps, or would, and which corners lie inside.
struct Cell {
  int64_t offset = 0;
  unsigned inside = 0;
};

template <typename S, int Axes>
PRED_DEVICE_ONLY Cell find_cell(const SampleGridArgs<S, Axes>& a, int64_t map,
                                const LinearStencil<Compute<S>, Axes>& s) {
  Cell cell;
  cell.offset = map * a.stride[Axes];
  for (int axis = 0; axis < Axes; ++axis) cell.offset += s.axis[axis].low * a.stride[axis];
#pragma unroll
  for (int k = 0; k < 1 << Axes; ++k) cell.inside |= unsigned(linear_inside(s, k)) << k;
  return cell;
}

PRED_DEVICE_ONLY Cell cell_of_lane(const Cell& own, int from) {
  return {broadcast(own.offset, from), broadcast(own.inside, from)};
}

// From the lower corner to corner k.
template <typename S, int Axes>
PRED_DEVICE_ONLY int64_t to_corner(const SampleGridArgs<S, Axes>& a, int k) {
  int64_t step = 0;
  for (int axis = 0; axis < Axes; ++axis) step += (k >> axis & 1) * a.stride[axis];
  return step;
}

// A warp has 32 neighbouring samples: each lane finds the cell and weights of one, which the groups then take in turn.
template <int kOuts, int V, typename S, int Axes>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(SampleGridArgs<S, Axes> a, S* out, S* slopes, int64_t num_samples, int lanes) {
  using T = Compute<S>;
  constexpr int kCorners = 1 << Axes;
  const Group group(lanes);
  for (int64_t base = first_warp() * kWarp; base < num_samples; base += warp_stride() * kWarp) {
    const int64_t own = base + lane_number();
    T own_weight[kOuts][kCorners] = {};
    Cell own_cell;
    if (own < num_samples) {
      const auto s = stencil(a, own);
      forward_weights<kOuts>(s, own_weight);
      own_cell = find_cell(a, divide(own, a.num_samples), s);
    }
    for (int turn = 0; turn < kWarp && base + turn < num_samples; turn += group.per_warp()) {
      const int from = turn + group.number();
      const int64_t sample = base + from;
      const Cell cell = cell_of_lane(own_cell, from);
      T weight[kOuts][kCorners];
#pragma unroll
      for (int m = 0; m < kOuts; ++m) {
        for (int k = 0; k < kCorners; ++k) weight[m][k] = broadcast(own_weight[m][k], from);
      }
      if (sample >= num_samples) continue;
      for (int64_t c = group.lane * V; c < a.channels; c += group.size * V) {
        T sum[kOuts][V] = {};
#pragma unroll
        for (int k = 0; k < kCorners; ++k) {
          T value[V];
          load_constant_pack<V>(cell.inside >> k & 1 ? a.map + (cell.offset + to_corner(a, k) + c) : nullptr, value);
#pragma unroll
          for (int m = 0; m < kOuts; ++m) {
            for (int v = 0; v < V; ++v) sum[m][v] += value[v] * weight[m][k];
          }
        }
        store_pack<V>(out + sample * a.channels + c, sum[0]);
#pragma unroll
        for (int m = 1; m < kOuts; ++m) store_pack<V>(slopes + (sample * Axes + m - 1) * a.channels + c, sum[m]);
      }
    }
  }
}

// dots[k] += sum over the lane's channels of source[c] row_k[c]
template <int V, int kCorners, typename S>
PRED_DEVICE_ONLY void add_dots(const Group& group, const S* source, const S* const (&row)[kCorners], int64_t channels,
                               Compute<S> (&dots)[kCorners]) {
  if (!source) return;
  for (int64_t c = group.lane * V; c < channels; c += group.size * V) {
    Compute<S> from[V];
    load_pack<V>(source + c, from);
#pragma unroll
    for (int k = 0; k < kCorners; ++k) {
      Compute<S> value[V];
      load_pack<V>(row[k] ? row[k] + c : nullptr, value);
      for (int v = 0; v < V; ++v) dots[k] += from[v] * value[v];
    }
  }
}

template <int kRows, int V, typename S, int Axes>
__global__ void __launch_bounds__(kThreads)
    backward_grid_kernel(SampleGridArgs<S, Axes> a, Compute<S>* grad_grid, int64_t num_samples, int lanes) {
  using T = Compute<S>;
  const Group group(lanes);
  // All lanes of a warp go on together, for the sums over groups.
  for (int64_t sample = group.first(); __any_sync(kWholeWarp, sample < num_samples); sample += group.stride()) {
    T gradient[Axes] = {};
    if (sample < num_samples) {
      const auto s = stencil(a, sample);
      const Corners<S, Axes> p(a.map + divide(sample, a.num_samples) * a.stride[Axes], a, s);
      for (int m = 0; p.any && m < kRows; ++m) {
        T dots[1 << Axes] = {};
        add_dots<V>(group, gradient_row<kRows>(a, sample, m), p.row, a.channels, dots);
#pragma unroll
        for (int axis = 0; axis < Axes; ++axis) {
          if (m == 0) gradient[axis] += linear_interpolate(s, 1 << axis, dots);
          if (m > 0 && m - 1 != axis) gradient[axis] += linear_interpolate(s, 1 << axis | 1 << (m - 1), dots);
        }
      }
    }
#pragma unroll
    for (int axis = 0; axis < Axes; ++axis) {
      const T sum = sum_lanes(gradient[axis], group.size);
      if (group.lane == 0 && sample < num_samples) grad_grid[sample * Axes + axis] = sum;
    }
  }
}

template <int V, typename S, int Axes>
__global__ void __launch_bounds__(kThreads)
    double_backward_kernel(SampleGridArgs<S, Axes> a, S* grad_out, Compute<S>* grad_grid, int64_t num_samples,
                           int lanes) {
  using T = Compute<S>;
  constexpr int kCorners = 1 << Axes;
  const Group group(lanes);
  for (int64_t sample = group.first(); __any_sync(kWholeWarp, sample < num_samples); sample += group.stride()) {
    T gradient[Axes] = {};
    if (sample < num_samples) {
      const auto s = stencil(a, sample);
      const int64_t offset = divide(sample, a.num_samples) * a.stride[Axes];
      T direction[Axes] = {};
      for (int axis = 0; a.grad_grad_grid && axis < Axes; ++axis) {
        direction[axis] = a.grad_grad_grid[sample * Axes + axis];
      }
      const Corners<S, Axes> p(a.map + offset, a, s);
      const Corners<S, Axes> u((a.grad_grad_map ? a.grad_grad_map : a.map) + offset, a, s);
      if (grad_out) {
        T along[kCorners], weight[kCorners];
        linear_directional(s, direction, along);
        linear_weights(s, 0, weight);
        for (int64_t c = group.lane * V; c < a.channels; c += group.size * V) {
          T sum[V] = {}, value[V];
#pragma unroll
          for (int k = 0; k < kCorners; ++k) {
            load_pack<V>(p.row[k] ? p.row[k] + c : nullptr, value);
            for (int v = 0; v < V; ++v) sum[v] += value[v] * along[k];
            if (!a.grad_grad_map) continue;
            load_pack<V>(u.row[k] ? u.row[k] + c : nullptr, value);
            for (int v = 0; v < V; ++v) sum[v] += value[v] * weight[k];
          }
          store_pack<V>(grad_out + sample * a.channels + c, sum);
        }
      }
      const S* grad = a.grad + sample * a.channels;
      if (grad_grid && p.any && a.grad_grad_map) {
        T dots[kCorners] = {};
        add_dots<V>(group, grad, u.row, a.channels, dots);
        for (int axis = 0; axis < Axes; ++axis) gradient[axis] = linear_interpolate(s, 1 << axis, dots);
      }
      if (grad_grid && p.any && a.grad_grad_grid) {
        T dots[kCorners] = {};
        add_dots<V>(group, grad, p.row, a.channels, dots);
#pragma unroll
        for (int axis = 1; axis < Axes; ++axis) {
          for (int other = 0; other < axis; ++other) {
            const T mixed = linear_interpolate(s, 1 << axis | 1 << other, dots);
            gradient[axis] += mixed * direction[other];
            gradient[other] += mixed * direction[axis];
          }
        }
      }
    }
#pragma unroll
    for (int axis = 0; axis < Axes; ++axis) {
      const T sum = sum_lanes(gradient[axis], group.size);
      if (grad_grid && group.lane == 0 && sample < num_samples) grad_grid[sample * Axes + axis] = sum;
    }
  }
}

// --- Scatter -------------------------------------------------------------------------------------
constexpr int64_t kPiece = 64;

// Lower corners: cells and those one below along each axis, in the order of maps, then z, y, x.
template <int Axes>
struct LowerCorners {
  int64_t side[Axes];  // W + 1, H + 1(, D + 1)
  int64_t count;
  int number_bits, key_bits;  // of an item: the sample's number, and above it the key; `count` is that of no cell

  template <typename S>
  LowerCorners(const SampleGridArgs<S, Axes>& a, int64_t batch) {
    count = batch;
    for (int axis = 0; axis < Axes; ++axis) {
      side[axis] = a.size[axis] + 1;
      count *= side[axis];
    }
    number_bits = bits_for(batch * a.num_samples);
    key_bits = bits_for(count + 1);
  }

  // That of the cell in which a sample of map number `map` lies; -1 where it touches no cell.
  template <typename T>
  __device__ int64_t key_of(int64_t map, const LinearStencil<T, Axes>& s) const {
    int64_t low[Axes];
    for (int axis = 0; axis < Axes; ++axis) {
      if (!s.axis[axis].low_inside && !s.axis[axis].high_inside) return -1;
      low[axis] = s.axis[axis].low;
    }
    return key(map, low);
  }

  // Of the cell whose lower corner has coordinates `low`, from -1 on.
  __device__ int64_t key(int64_t map, const int64_t (&low)[Axes]) const {
    int64_t number = map;
    for (int axis = Axes - 1; axis >= 0; --axis) number = number * side[axis] + low[axis] + 1;
    return number;
  }
};

// The parts of the workspace.
template <typename S, int Axes>
struct ScatterWorkspace {
  uint64_t *items, *sorted;  // [N]
  int64_t* start;            // [corners + 1], of each run
  Compute<S>* pieces;        // [N / kPiece, 2^Axes, C], of which those within one run are filled
  char* sort;
  int64_t sort_bytes, bytes;

  ScatterWorkspace(const SampleGridArgs<S, Axes>& a, const LowerCorners<Axes>& corners, int64_t batch, char* memory) {
    const int64_t samples = batch * a.num_samples;
    sort_bytes = pred::sort_bytes(samples, corners.number_bits, corners.number_bits + corners.key_bits);
    Workspace space(memory);
    items = space.take<uint64_t>(samples);
    sorted = space.take<uint64_t>(samples);
    start = space.take<int64_t>(corners.count + 1);
    pieces = space.take<Compute<S>>(samples / kPiece * (int64_t(1) << Axes) * a.channels);
    sort = space.take<char>(sort_bytes);
    bytes = space.bytes();
  }
};

template <typename S, int Axes>
__global__ void pack_kernel(SampleGridArgs<S, Axes> a, LowerCorners<Axes> corners, int64_t num_samples,
                            uint64_t* items) {
  for (int64_t sample = first_thread(); sample < num_samples; sample += thread_stride()) {
    const int64_t key = corners.key_of(divide(sample, a.num_samples), stencil(a, sample));
    items[sample] = uint64_t(key < 0 ? corners.count : key) << corners.number_bits | uint64_t(sample);
  }
}

// The weights with which a sample's gradient rows are added to its cells.
template <int kRows, typename S, int Axes>
PRED_DEVICE_ONLY void scatter_weights(const SampleGridArgs<S, Axes>& a, int64_t sample, bool along_direction,
                                      Compute<S> (&weight)[kRows][1 << Axes]) {
  const auto s = stencil(a, sample);
  if (along_direction) {
    linear_directional(s, a.grad_grad_grid + sample * Axes, weight[0]);
  } else {
    linear_weights(s, 0, weight[0]);
  }
  if constexpr (kRows == kAlong) {
    linear_directional(s, a.grad_grad_grid + sample * Axes, weight[1]);
  } else {
#pragma unroll
    for (int m = 1; m < kRows; ++m) linear_weights(s, 1 << (m - 1), weight[m]);
  }
}

// sum[k][v] += what the items [first, last) send to corner `from` + k, in channels c + v.
template <int kRows, int kCells, int V, typename S, int Axes>
PRED_DEVICE_ONLY void add_items(const SampleGridArgs<S, Axes>& a, const uint64_t* items, int number_bits,
                                bool along_direction, int64_t first, int64_t last, int from, int64_t c,
                                Compute<S> (&sum)[kCells][V]) {
  using T = Compute<S>;
  const uint64_t number_mask = (uint64_t(1) << number_bits) - 1;
  for (int64_t turn = first; turn < last; turn += kWarp) {
    const int64_t item = turn + lane_number();
    int64_t own = 0;
    T weight[kRows][1 << Axes] = {};
    if (item < last) {
      own = int64_t(items[item] & number_mask);
      scatter_weights<kRows>(a, own, along_direction, weight);
    }
    T own_weight[kRows][kCells] = {};
#pragma unroll
    for (int m = 0; m < kRows; ++m) {
#pragma unroll
      for (int corner = 0; corner < 1 << Axes; ++corner) {  // registers are not indexed by `from`
        for (int k = 0; k < kCells; ++k) {
          if (corner == from + k) own_weight[m][k] = weight[m][corner];
        }
      }
    }
    const int count = last - turn < kWarp ? int(last - turn) : kWarp;
    for (int i = 0; i < count; ++i) {
      const int64_t sample = broadcast(own, i);
#pragma unroll
      for (int m = 0; m < kRows; ++m) {
        T value[V];
        const S* row = gradient_row<kRows>(a, sample, m);
        load_pack<V>(row && c < a.channels ? row + c : nullptr, value);
#pragma unroll
        for (int k = 0; k < kCells; ++k) {
          const T factor = broadcast(own_weight[m][k], i);
          for (int v = 0; v < V; ++v) sum[k][v] += factor * value[v];
        }
      }
    }
  }
}

template <int kRows, int V, typename S, int Axes>
__global__ void __launch_bounds__(kThreads)
    piece_kernel(SampleGridArgs<S, Axes> a, LowerCorners<Axes> corners, ScatterWorkspace<S, Axes> space,
                 bool along_direction, int64_t num_pieces) {
  constexpr int kCorners = 1 << Axes;
  for (int64_t piece = first_warp(); piece < num_pieces; piece += warp_stride()) {
    const int64_t first = piece * kPiece, last = first + kPiece;
    const int64_t key = int64_t(space.sorted[first] >> corners.number_bits);
    if (key == corners.count || int64_t(space.sorted[last - 1] >> corners.number_bits) != key) continue;
    for (int64_t c = lane_number() * V; c - lane_number() * V < a.channels; c += kWarp * V) {
      Compute<S> sum[kCorners][V] = {};
      add_items<kRows>(a, space.sorted, corners.number_bits, along_direction, first, last, 0, c, sum);
      if (c >= a.channels) continue;
#pragma unroll
      for (int k = 0; k < kCorners; ++k) store_pack<V>(space.pieces + (piece * kCorners + k) * a.channels + c, sum[k]);
    }
  }
}

template <int kRows, int V, typename S, int Axes>
__global__ void __launch_bounds__(kThreads)
    cell_kernel(SampleGridArgs<S, Axes> a, LowerCorners<Axes> corners, ScatterWorkspace<S, Axes> space,
                bool along_direction, int64_t num_cells, S* grad_map) {
  using T = Compute<S>;
  constexpr int kCorners = 1 << Axes;
  for (int64_t cell = first_warp(); cell < num_cells; cell += warp_stride()) {
    int64_t at[Axes], map = cell;
    for (int axis = 0; axis < Axes; ++axis) {
      const int64_t next = divide(map, a.size[axis]);
      at[axis] = map - next * a.size[axis];
      map = next;
    }
    for (int64_t c = lane_number() * V; c - lane_number() * V < a.channels; c += kWarp * V) {
      T sum[1][V] = {};
      for (int k = 0; k < kCorners; ++k) {
        int64_t low[Axes];
        for (int axis = 0; axis < Axes; ++axis) low[axis] = at[axis] - (k >> axis & 1);
        const int64_t key = corners.key(map, low), first = space.start[key], last = space.start[key + 1];
        int64_t whole = (first + kPiece - 1) / kPiece, whole_end = last / kPiece;
        if (whole >= whole_end) whole = whole_end = (last + kPiece - 1) / kPiece + 1;  // behind them all: none
        const int64_t head_end = whole * kPiece < last ? whole * kPiece : last;
        add_items<kRows>(a, space.sorted, corners.number_bits, along_direction, first, head_end, k, c, sum);
        for (int64_t piece = whole; piece < whole_end; ++piece) {
          T value[V];
          load_pack<V>(c < a.channels ? space.pieces + (piece * kCorners + k) * a.channels + c : nullptr, value);
          for (int v = 0; v < V; ++v) sum[0][v] += value[v];
        }
        if (whole < whole_end) {
          add_items<kRows>(a, space.sorted, corners.number_bits, along_direction, whole_end * kPiece, last, k, c, sum);
        }
      }
      if (c < a.channels) store_pack<V>(grad_map + cell * a.channels + c, sum[0]);
    }
  }
}

// --- Scatter with atomics ------------------------------------------------------------------------
template <int V, typename T>
PRED_DEVICE_ONLY void add_pack(T* to, const T (&value)[V]) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  if constexpr (std::is_same_v<T, float> && V == 4) {
    atomicAdd(reinterpret_cast<float4*>(to), make_float4(value[0], value[1], value[2], value[3]));
  } else
#endif
  {
#pragma unroll
    for (int v = 0; v < V; ++v) atomicAdd(to + v, value[v]);
  }
}

// A warp has 32 neighbouring samples, of which each lane finds one's cell and weights, and each group takes as many
// side by side as it has lanes. Gradients are added up as long as samples lie in one cell.
template <int kRows, int V, typename S, int Axes>
__global__ void __launch_bounds__(kThreads)
    run_kernel(SampleGridArgs<S, Axes> a, bool along_direction, int64_t num_samples, int lanes, S* grad_map) {
  using T = Compute<S>;
  constexpr int kCorners = 1 << Axes;
  const Group group(lanes);
  for (int64_t base = first_warp() * kWarp; base < num_samples; base += warp_stride() * kWarp) {
    const int64_t own = base + lane_number();
    T own_weight[kRows][kCorners] = {};
    Cell own_cell;
    if (own < num_samples) {
      own_cell = find_cell(a, divide(own, a.num_samples), stencil(a, own));
      scatter_weights<kRows>(a, own, along_direction, own_weight);
    }
    for (int64_t c = group.lane * V; c - group.lane * V < a.channels; c += group.size * V) {  // as often in each lane
      T sum[kCorners][V] = {};
      Cell held;
      const auto add = [&] {
#pragma unroll
        for (int k = 0; k < kCorners; ++k) {
          if (held.inside >> k & 1) add_pack<V>(grad_map + (held.offset + to_corner(a, k) + c), sum[k]);
#pragma unroll
          for (int v = 0; v < V; ++v) sum[k][v] = 0;
        }
      };
      for (int turn = 0; turn < group.size; ++turn) {
        const int from = group.number() * group.size + turn;
        const Cell cell = cell_of_lane(own_cell, from);
        T weight[kRows][kCorners];
#pragma unroll
        for (int m = 0; m < kRows; ++m) {
          for (int k = 0; k < kCorners; ++k) weight[m][k] = broadcast(own_weight[m][k], from);
        }
        if (cell.inside == 0 || c >= a.channels) continue;
        if (cell.offset != held.offset || cell.inside != held.inside) {
          add();
          held = cell;
        }
#pragma unroll
        for (int m = 0; m < kRows; ++m) {
          T value[V];
          const S* row = gradient_row<kRows>(a, base + from, m);
          load_constant_pack<V>(row ? row + c : nullptr, value);
#pragma unroll
          for (int k = 0; k < kCorners; ++k) {
            for (int v = 0; v < V; ++v) sum[k][v] += weight[m][k] * value[v];
          }
        }
      }
      add();
    }
  }
}

// --- Launches ------------------------------------------------------------------------------------
template <typename S, int Axes>
void forward(const SampleGridArgs<S, Axes>& a, S* out, S* slopes, int64_t, int64_t num_samples) {
  by_pack<S>(in_packs<S>(a.channels, a.map, out, slopes), a.channels, [&](auto pack, int lanes) {
    constexpr int V = decltype(pack)::value;
    launch_warps(slopes ? forward_kernel<1 + Axes, V, S, Axes> : forward_kernel<1, V, S, Axes>,
                 (num_samples + kWarp - 1) / kWarp, a, out, slopes, num_samples, lanes);
  });
}

template <typename S, int Axes>
void backward_grid(const SampleGridArgs<S, Axes>& a, Compute<S>* grad_grid, int64_t, int64_t num_samples) {
  by_pack<S>(in_packs<S>(a.channels, a.map, a.grad, a.grad_slopes), a.channels, [&](auto pack, int lanes) {
    constexpr int V = decltype(pack)::value;
    launch_threads(a.grad_slopes ? backward_grid_kernel<1 + Axes, V, S, Axes> : backward_grid_kernel<1, V, S, Axes>,
                   num_samples * lanes, a, grad_grid, num_samples, lanes);
  });
}

template <typename S, int Axes>
void double_backward(const SampleGridArgs<S, Axes>& a, S* grad_out, Compute<S>* grad_grid, int64_t,
                     int64_t num_samples) {
  by_pack<S>(in_packs<S>(a.channels, a.map, a.grad, a.grad_grad_map, grad_out), a.channels, [&](auto pack, int lanes) {
    constexpr int V = decltype(pack)::value;
    launch_threads(double_backward_kernel<V, S, Axes>, num_samples * lanes, a, grad_out, grad_grid, num_samples, lanes);
  });
}

template <typename S, int Axes>
int64_t scatter_bytes(const SampleGridArgs<S, Axes>& a, int64_t batch) {
  return ScatterWorkspace<S, Axes>(a, LowerCorners<Axes>(a, batch), batch, nullptr).bytes;
}

template <int kRows, typename S, int Axes>
void scatter_rows(const SampleGridArgs<S, Axes>& a, int64_t batch, bool along_direction, S* grad_map,
                  const LowerCorners<Axes>& corners, const ScatterWorkspace<S, Axes>& space) {
  const int64_t num_samples = batch * a.num_samples, num_cells = batch * (a.stride[Axes] / a.channels);
  by_pack<S>(in_packs<S>(a.channels, a.grad, a.grad_slopes, a.grad_along, grad_map), a.channels, [&](auto pack, int) {
    constexpr int V = decltype(pack)::value;
    launch_warps(piece_kernel<kRows, V, S, Axes>, num_samples / kPiece, a, corners, space, along_direction,
                 num_samples / kPiece);
    launch_warps(cell_kernel<kRows, V, S, Axes>, num_cells, a, corners, space, along_direction, num_cells, grad_map);
  });
}

template <typename S, int Axes>
void scatter(const SampleGridArgs<S, Axes>& a, int64_t batch, bool along_direction, S* grad_map, char* workspace) {
  const LowerCorners<Axes> corners(a, batch);
  const ScatterWorkspace<S, Axes> space(a, corners, batch, workspace);
  const int64_t num_samples = batch * a.num_samples;
  launch_threads(pack_kernel<S, Axes>, num_samples, a, corners, num_samples, space.items);
  sort_items(space.sort, space.sort_bytes, space.items, space.sorted, num_samples, corners.number_bits,
             corners.number_bits + corners.key_bits);
  find_runs(space.sorted, num_samples, corners.number_bits, corners.count, space.start);
  if (a.grad_along) {
    scatter_rows<kAlong>(a, batch, false, grad_map, corners, space);
  } else if (a.grad_slopes) {
    scatter_rows<1 + Axes>(a, batch, along_direction, grad_map, corners, space);
  } else {
    scatter_rows<1>(a, batch, along_direction, grad_map, corners, space);
  }
}

template <int kRows, typename S, int Axes>
void add_runs(const SampleGridArgs<S, Axes>& a, int64_t batch, bool along_direction, S* grad_map) {
  const int64_t num_samples = batch * a.num_samples;
  by_pack<S>(in_packs<S>(a.channels, a.grad, a.grad_slopes, a.grad_along, grad_map), a.channels,
             [&](auto pack, int lanes) {
               launch_warps(run_kernel<kRows, decltype(pack)::value, S, Axes>, (num_samples + kWarp - 1) / kWarp, a,
                            along_direction, num_samples, lanes, grad_map);
             });
}

template <typename S, int Axes>
void scatter_atomically(const SampleGridArgs<S, Axes>& a, int64_t batch, bool along_direction, S* grad_map) {
  if (a.grad_along) {
    add_runs<kAlong>(a, batch, false, grad_map);
  } else if (a.grad_slopes) {
    add_runs<1 + Axes>(a, batch, along_direction, grad_map);
  } else {
    add_runs<1>(a, batch, along_direction, grad_map);
  }
}

template <typename S, int Axes>
constexpr SampleGridKernels<S, Axes> sample_grid_kernels() {
  SampleGridKernels<S, Axes> table{};
  table.forward = forward;
  table.backward_grid = backward_grid;
  table.double_backward = double_backward;
  table.scatter_bytes = scatter_bytes;
  table.scatter = scatter;
  if constexpr (std::is_same_v<S, Compute<S>>) table.scatter_atomically = scatter_atomically;
  return table;
}

}  // namespace
}  // namespace pred::PRED_ISA
