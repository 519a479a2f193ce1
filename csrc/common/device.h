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

#include <optional>
#include <type_traits>

#if defined(PRED_LAUNCH) && !defined(PRED_EMULATED)
#include <torch/csrc/stable/accelerator.h>

#include "nvtx3/nvToolsExt.h"
#define PRED_DEVICE CUDA
#else
#define PRED_DEVICE CPU
#endif

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

template <auto function, class Name>
struct OnDevice;
template <class Result, class... Arguments, Result (*function)(Arguments...), class Name>
struct OnDevice<function, Name> {
  static Result call(Arguments... arguments) {
    const DeviceScope scope(Name::text(), arguments...);
    return function(arguments...);
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
#else
constexpr const char* kRightDevice = "a CPU tensor";
inline bool on_right_device(const torch::stable::Tensor& tensor) { return tensor.is_cpu(); }

#define PRED_IMPL(m, name, function) m.impl(name, TORCH_BOX(function))
#endif

}  // namespace pred
