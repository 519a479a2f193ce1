// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CPU driver: an index loop on torch's own thread pool, so that torch.set_num_threads is obeyed and no
// second OpenMP runtime enters the process.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <exception>
#include <vector>

namespace pred {

// Calls body(begin, end) on disjoint ranges that cover [0, count). An exception's text would be lost
// on its way through torch's C interface: the first one is kept and rethrown here.
template <class Body>
void parallel(int64_t count, int64_t grain, const Body& body) {
  if (count <= 0) return;
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

// One thread, in order: the same bits for any number of threads.
inline double ordered_sum(const std::vector<double>& parts) {
  double sum = 0;
  for (const double part : parts) sum += part;
  return sum;
}

}  // namespace pred
