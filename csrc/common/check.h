// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Argument checks of the bindings. Python checks first and has the better words; these protect memory
// when torch.ops.pred.* is called directly. std::invalid_argument becomes ValueError in Python.
#pragma once

#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/device.h"
#include "math/half.h"

namespace pred {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class... Parts>
std::string concat(const Parts&... parts) {
  std::ostringstream text;
  (text << ... << parts);
  return text.str();
}

inline std::vector<int64_t> sizes(const Tensor& tensor) {
  std::vector<int64_t> found;
  for (int64_t dim = 0; dim < tensor.dim(); ++dim) found.push_back(tensor.size(dim));
  return found;
}

inline std::string shape_text(const std::vector<int64_t>& shape) {
  std::string text;
  for (const int64_t size : shape) text += (text.empty() ? "" : ", ") + std::to_string(size);
  return "[" + text + "]";
}
inline std::string shape_text(const Tensor& tensor) { return shape_text(sizes(tensor)); }

#define PRED_CHECK(condition, ...)                                              \
  do {                                                                          \
    if (!(condition)) throw std::invalid_argument(::pred::concat(__VA_ARGS__)); \
  } while (0)

inline void check_tensor(const char* op, const char* name, const Tensor& tensor, int64_t dim, ScalarType dtype) {
  PRED_CHECK(on_right_device(tensor), op, ": ", name, " must be ", kRightDevice, ", got one on another device");
  PRED_CHECK(tensor.dim() == dim, op, ": ", name, " must have ", dim, " dimensions, got shape ", shape_text(tensor));
  PRED_CHECK(tensor.scalar_type() == dtype, op, ": ", name, " must have dtype ", torch::headeronly::toString(dtype),
             ", got ", torch::headeronly::toString(tensor.scalar_type()));
}

inline void check_sizes(const char* op, const char* name, const Tensor& tensor, const std::vector<int64_t>& shape) {
  PRED_CHECK(sizes(tensor) == shape, op, ": ", name, " must have shape ", shape_text(shape), ", got ",
             shape_text(tensor));
}

// The sharpness of a sigmoid.
template <typename T>
const T* sharpness(const char* op, const Tensor& inv_s, ScalarType dtype) {
  check_tensor(op, "inv_s", inv_s, 0, dtype);
  const T* value = inv_s.const_data_ptr<T>();
  if constexpr (!kLaunch) {
    PRED_CHECK(*value >= 0 && *value <= std::numeric_limits<T>::max(), op,
               ": inv_s must be finite and not negative, got ", *value);
  }
  return value;
}

[[noreturn]] inline void refuse_dtype(const std::string& op, const char* allowed, ScalarType dtype) {
  throw std::invalid_argument(op + ": dtype must be " + allowed + ", got " + torch::headeronly::toString(dtype));
}

#define PRED_DISPATCH_CASE(dtype, Stored, ...)          \
  case ::pred::ScalarType::dtype: {                     \
    using S [[maybe_unused]] = Stored;                  \
    using T [[maybe_unused]] = ::pred::Compute<Stored>; \
    return __VA_ARGS__();                               \
  }

// These call a body with S, the type of what is stored, and T = Compute<S>. Pointers to storage: storage<S>(tensor),
// mutable_storage<S>(tensor).
#define PRED_DISPATCH_FLOAT(op, dtype, ...)                    \
  [&] {                                                        \
    switch (dtype) {                                           \
      PRED_DISPATCH_CASE(Float, float, __VA_ARGS__)            \
      PRED_DISPATCH_CASE(Double, double, __VA_ARGS__)          \
      default:                                                 \
        ::pred::refuse_dtype(op, "float32 or float64", dtype); \
    }                                                          \
  }()

// The types of products' operands.
#define PRED_DISPATCH_FACTOR(op, dtype, ...)                             \
  [&] {                                                                  \
    switch (dtype) {                                                     \
      PRED_DISPATCH_CASE(Float, float, __VA_ARGS__)                      \
      PRED_DISPATCH_CASE(Double, double, __VA_ARGS__)                    \
      PRED_DISPATCH_CASE(BFloat16, ::pred::BFloat16, __VA_ARGS__)        \
      default:                                                           \
        ::pred::refuse_dtype(op, "float32, float64 or bfloat16", dtype); \
    }                                                                    \
  }()

#define PRED_DISPATCH_STORAGE(op, dtype, ...)                                     \
  [&] {                                                                           \
    switch (dtype) {                                                              \
      PRED_DISPATCH_CASE(Float, float, __VA_ARGS__)                               \
      PRED_DISPATCH_CASE(Double, double, __VA_ARGS__)                             \
      PRED_DISPATCH_CASE(BFloat16, ::pred::BFloat16, __VA_ARGS__)                 \
      PRED_DISPATCH_CASE(Half, ::pred::Float16, __VA_ARGS__)                      \
      default:                                                                    \
        ::pred::refuse_dtype(op, "float32, float64, bfloat16 or float16", dtype); \
    }                                                                             \
  }()

template <typename S>
const S* storage(const Tensor& tensor) {
  return static_cast<const S*>(tensor.const_data_ptr());
}

template <typename S>
S* mutable_storage(const Tensor& tensor) {
  return static_cast<S*>(tensor.mutable_data_ptr());
}

}  // namespace pred
