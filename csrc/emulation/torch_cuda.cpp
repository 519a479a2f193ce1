// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What libpred_cuda takes from libtorch_cuda, for machines without it. Not installed.
extern "C" __attribute__((visibility("default"))) int aoti_torch_get_current_cuda_stream(int, void** stream) {
  *stream = nullptr;
  return 0;
}
