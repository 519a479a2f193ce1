// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The library that a binding is built into. ops/<op>.cpp is one source for all:
//   libpred_cpu                      kernels are loops over ranges, and common/parallel.h divides the work
//   libpred_cuda, PRED_LAUNCH        kernels are launched on everything at once
//   PRED_LAUNCH and PRED_EMULATED    the same kernels run on the CPU, on its tensors (emulation/cuda.h): for tests
//
// A launching binding reads no element of a tensor, so that the host never waits for the device: what it has no need to
// know is not checked, and kernels stay inside their memory whatever the values are.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>

#include <cstring>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>

#if defined(PRED_LAUNCH) && !defined(PRED_EMULATED)
#include <torch/csrc/stable/accelerator.h>

#include "nvtx3/nvToolsExt.h"
#define PRED_DEVICE CUDA
#else
#define PRED_DEVICE CPU
#endif

// Of torch 2.13 and later; null in others.
extern "C" __attribute__((weak)) const char* torch_exception_get_what_without_backtrace();

namespace pred {

#ifdef PRED_LAUNCH
constexpr bool kLaunch = true;
#else
constexpr bool kLaunch = false;
#endif

// Whether a binding built here can work on the tensor; where it cannot, kRightDevice says on what it could.
#if defined(PRED_LAUNCH) && !defined(PRED_EMULATED)
constexpr const char* kRightDevice = "on the CUDA device of the first tensor";
inline bool on_right_device(const torch::stable::Tensor& tensor) {
  return tensor.is_cuda() && tensor.get_device_index() == torch::stable::accelerator::getCurrentDeviceIndex();
}

// Makes the device of the first tensor the current one, and marks the call in a profile.
class DeviceScope {
 public:
  template <class... Arguments>
  explicit DeviceScope(const char* op, const Arguments&... arguments) : guard_(first_device(arguments...)) {
    nvtxRangePushA(op);
  }
  ~DeviceScope() { nvtxRangePop(); }
  DeviceScope(const DeviceScope&) = delete;
  DeviceScope& operator=(const DeviceScope&) = delete;

 private:
  static int32_t first_device() { return 0; }
  template <class First, class... Rest>
  static int32_t first_device(const First& first, const Rest&... rest) {
    if constexpr (std::is_same_v<First, torch::stable::Tensor>) {
      return first.get_device_index();
    } else {
      return first_device(rest...);
    }
  }

  torch::stable::accelerator::DeviceGuard guard_;
};
#else
constexpr const char* kRightDevice = "a CPU tensor";
inline bool on_right_device(const torch::stable::Tensor& tensor) { return tensor.is_cpu(); }

struct DeviceScope {
  template <class... Arguments>
  explicit DeviceScope(const char*, const Arguments&...) {}
};
#endif

// What torch's headers throw names the function of torch that failed, most often for want of memory. Why it failed,
// torch keeps for those who ask (from 2.13 on), or has printed.
[[noreturn]] inline void rethrow_with_cause(const char* op, const std::runtime_error& error) {
  const bool of_torch = std::strstr(error.what(), "API call failed") != nullptr;
  const char* cause =
      of_torch && torch_exception_get_what_without_backtrace ? torch_exception_get_what_without_backtrace() : nullptr;
  if (!cause) throw;
  throw std::runtime_error(std::string(op) + ": " + cause);
}

template <auto function, class Name>
struct OnDevice;
template <class Result, class... Arguments, Result (*function)(Arguments...), class Name>
struct OnDevice<function, Name> {
  static Result call(Arguments... arguments) {
    const DeviceScope scope(Name::text(), arguments...);
    try {
      return function(arguments...);
    } catch (const std::runtime_error& error) {
      rethrow_with_cause(Name::text(), error);
    }
  }
};

// In a STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m): the op of this name.
#define PRED_IMPL(m, name, function)                                    \
  do {                                                                  \
    struct Name {                                                       \
      static const char* text() { return "pred::" name; }               \
    };                                                                  \
    m.impl(name, TORCH_BOX((&::pred::OnDevice<function, Name>::call))); \
  } while (0)

}  // namespace pred
