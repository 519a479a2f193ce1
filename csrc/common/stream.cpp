// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "common/stream.h"

#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>

#include <stdexcept>

namespace pred {

void* current_stream() {
  void* stream = nullptr;
  if (aoti_torch_get_current_cuda_stream(torch::stable::accelerator::getCurrentDeviceIndex(), &stream) != 0) {
    throw std::runtime_error("pred: torch has no current CUDA stream");
  }
  return stream;
}

}  // namespace pred
