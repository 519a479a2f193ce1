// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Scratch of kernels that are launched: parts of one block of the device's memory, 256 bytes apart. From null, only
// `bytes` is of use, their total size.
#pragma once

#include <stdint.h>

namespace pred {

class Workspace {
 public:
  explicit Workspace(char* memory) : memory_(memory) {}

  template <typename T>
  T* take(int64_t count) {
    char* part = memory_ ? memory_ + bytes_ : nullptr;
    bytes_ += (count * int64_t(sizeof(T)) + 255) / 256 * 256;
    return reinterpret_cast<T*>(part);
  }

  int64_t bytes() const { return bytes_; }

 private:
  char* memory_;
  int64_t bytes_ = 0;
};

}  // namespace pred
