// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/segment_reduce.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <memory>
#include <string>
#include <tuple>

#include "common/allocate.h"
#include "common/check.h"
#include "common/parallel.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(SegmentReduceKernels, segment_reduce)

SegmentReduction reduction(const char* op, const std::string& name) {
  if (name == "sum") return SegmentReduction::kSum;
  if (name == "mean") return SegmentReduction::kMean;
  PRED_CHECK(name == "max", op, ": reduce must be one of sum, mean, max, got ", name);
  return SegmentReduction::kMax;
}

// Rows per task, such that a task moves some 64 kB.
int64_t row_grain(int64_t channels) { return 1 + 16384 / (channels + 4); }

// `index` lies in [-1, num_segments); the message names the first row for which it does not.
template <typename S>
void check_index(const char* op, const Tensor& index, int64_t num_segments) {
  const int64_t* data = index.const_data_ptr<int64_t>();
  const auto& k = segment_reduce_kernels<S>();
  std::atomic<bool> valid{true};
  parallel(index.size(0), 32768, [&](int64_t begin, int64_t end) {
    if (!k.is_valid(data, num_segments, begin, end)) valid = false;
  });
  for (int64_t row = 0; !valid; ++row) {
    PRED_CHECK(data[row] >= -1 && data[row] < num_segments, op, ": index must lie in [-1, num_segments=", num_segments,
               "), got ", data[row], " in row ", row);
  }
}

template <typename S>
std::tuple<Tensor, Tensor> forward(const char* op, const Tensor& features_in, const Tensor& index_in,
                                   int64_t num_segments, SegmentReduction how) {
  using T = Compute<S>;
  const SegmentReduceKernels<S>& k = segment_reduce_kernels<S>();
  const Tensor features = torch::stable::contiguous(features_in), index = torch::stable::contiguous(index_in);
  const int64_t num_rows = features.size(0), channels = features.size(1);

  Tensor out = torch::stable::new_empty(features, {num_segments, channels});
  Tensor saved = how == SegmentReduction::kSum ? torch::stable::new_empty(index, {0}, ScalarType::Int)
                 : how == SegmentReduction::kMean
                     ? torch::stable::new_empty(index, {num_segments}, ScalarType::Int)
                     : torch::stable::new_empty(index, {num_segments, channels}, ScalarType::Int);
  const SegmentReduceArgs<S> a{storage<S>(features), index.const_data_ptr<int64_t>(), num_rows, channels};
  if constexpr (kLaunch) {
    const Tensor workspace =
        torch::stable::new_empty(features, {k.workspace_bytes(num_rows, num_segments)}, ScalarType::Byte);
    k.forward(how, a, num_segments, mutable_storage<S>(out), saved.mutable_data_ptr<int32_t>(),
              mutable_storage<char>(workspace));
    return {out, saved};
  } else {
    check_index<S>(op, index, num_segments);
    std::unique_ptr<T[]> wide;
    if (!std::is_same_v<S, T>) wide = allocate_array<T>(num_segments * channels);
    T* results = wide ? wide.get() : static_cast<T*>(out.mutable_data_ptr());
    int32_t* saved_data = saved.mutable_data_ptr<int32_t>();
    // Each task reads the whole index: no more tasks than there is work for.
    const int64_t num_tasks = 1 + num_rows * (channels + 4) / 32768;
    parallel(num_segments, num_segments / num_tasks,
             [&](int64_t begin, int64_t end) { k.forward[int(how)](a, results, saved_data, begin, end); });
    if (wide) {
      S* rounded = mutable_storage<S>(out);
      parallel(num_segments * channels, 32768,
               [&](int64_t begin, int64_t end) { k.round(results, rounded, begin, end); });
    }
    return {out, saved};
  }
}

std::tuple<Tensor, Tensor> segment_reduce(const Tensor& features, const Tensor& index, int64_t num_segments,
                                          std::string reduce) {
  const char* op = "segment_reduce";
  check_tensor(op, "features", features, 2, features.scalar_type());
  check_tensor(op, "index", index, 1, ScalarType::Long);
  PRED_CHECK(index.size(0) == features.size(0), op, ": index must have shape [", features.size(0), "], got ",
             shape_text(index));
  PRED_CHECK(num_segments >= 0, op, ": num_segments must not be negative, got ", num_segments);
  PRED_CHECK(features.size(0) < int64_t(1) << 31, op, ": features must have fewer than 2^31 rows, got ",
             features.size(0));
  const SegmentReduction how = reduction(op, reduce);
  return PRED_DISPATCH_STORAGE(op, features.scalar_type(),
                               [&] { return forward<S>(op, features, index, num_segments, how); });
}

template <typename S>
Tensor backward(const char* op, const Tensor& grad, const Tensor& index, const Tensor& saved, SegmentReduction how) {
  const int64_t num_segments = grad.size(0), channels = grad.size(1), num_rows = index.size(0);
  Tensor out = torch::stable::new_empty(grad, {num_rows, channels});
  const S* grad_data = storage<S>(grad);
  const int64_t* index_data = index.const_data_ptr<int64_t>();
  const int32_t* saved_data = saved.const_data_ptr<int32_t>();
  S* out_data = mutable_storage<S>(out);
  const auto& k = segment_reduce_kernels<S>();
  if constexpr (kLaunch) {
    k.backward(how, grad_data, num_segments, channels, index_data, saved_data, out_data, num_rows);
  } else {
    check_index<S>(op, index, num_segments);
    parallel(num_rows, row_grain(channels), [&](int64_t begin, int64_t end) {
      k.backward[int(how)](grad_data, channels, index_data, saved_data, out_data, begin, end);
    });
  }
  return out;
}

Tensor segment_reduce_backward(const Tensor& grad_in, const Tensor& index_in, const Tensor& saved_in,
                               std::string reduce) {
  const char* op = "segment_reduce_backward";
  check_tensor(op, "grad", grad_in, 2, grad_in.scalar_type());
  check_tensor(op, "index", index_in, 1, ScalarType::Long);
  const SegmentReduction how = reduction(op, reduce);
  const int64_t num_segments = grad_in.size(0), channels = grad_in.size(1);
  check_tensor(op, "saved", saved_in, how == SegmentReduction::kMax ? 2 : 1, ScalarType::Int);
  const bool fits = how == SegmentReduction::kSum || (saved_in.size(0) == num_segments &&
                                                      (how == SegmentReduction::kMean || saved_in.size(1) == channels));
  PRED_CHECK(fits, op, ": saved must belong to grad of shape ", shape_text(grad_in), ", got ", shape_text(saved_in));
  const Tensor grad = torch::stable::contiguous(grad_in), index = torch::stable::contiguous(index_in);
  const Tensor saved = torch::stable::contiguous(saved_in);
  return PRED_DISPATCH_STORAGE(op, grad.scalar_type(), [&] { return backward<S>(op, grad, index, saved, how); });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "segment_reduce", &pred::segment_reduce);
  PRED_IMPL(m, "segment_reduce_backward", &pred::segment_reduce_backward);
}
