// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CPU driver: an index loop on torch's own thread pool, so that torch.set_num_threads is obeyed and no
// second OpenMP runtime enters the process. In a binding that launches kernels (common/device.h), body is called once.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <exception>

#include "common/device.h"

namespace pred {

// Calls body(begin, end) on disjoint ranges that cover [0, count). An exception's text would be lost
// on its way through torch's C interface: the first one is kept and rethrown here.
template <class Body>
void parallel(int64_t count, int64_t grain, const Body& body) {
  if (count <= 0) return;
  if (kLaunch) return body(int64_t(0), count);
  std::exception_ptr error;
  std::atomic<bool> failed{false};
  torch::stable::parallel_for(0, count, grain < 1 ? 1 : grain, [&](int64_t begin, int64_t end) {
    try {
      body(begin, end);
    } catch (...) {
      if (!failed.exchange(true)) error = std::current_exception();
    }
  });
  if (error) std::rethrow_exception(error);
}

}  // namespace pred
