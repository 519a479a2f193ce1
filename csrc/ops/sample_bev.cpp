// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_bev.h"

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) {
  m.impl("sample_bev", TORCH_BOX(&pred::SampleBev::forward));
  m.impl("sample_bev_backward", TORCH_BOX(&pred::SampleBev::backward));
  m.impl("sample_bev_double_backward", TORCH_BOX(&pred::SampleBev::double_backward));
  m.impl("sample_bev_with_grad", TORCH_BOX(&pred::SampleBev::with_grad));
  m.impl("sample_bev_with_grad_backward", TORCH_BOX(&pred::SampleBev::with_grad_backward));
}
