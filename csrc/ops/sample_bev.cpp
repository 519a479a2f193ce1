// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_bev.h"

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "sample_bev", &pred::SampleBev::forward);
  PRED_IMPL(m, "sample_bev_backward", &pred::SampleBev::backward);
  PRED_IMPL(m, "sample_bev_double_backward", &pred::SampleBev::double_backward);
  PRED_IMPL(m, "sample_bev_with_grad", &pred::SampleBev::with_grad);
  PRED_IMPL(m, "sample_bev_with_grad_backward", &pred::SampleBev::with_grad_backward);
}
