// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The arguments by which sample_pdf and resample_rays name a rule.
#pragma once

#include <string>

#include "common/check.h"
#include "ops/sample_pdf.h"

namespace pred {

template <typename T>
PdfRule<T> read_pdf_rule(const char* op, const std::string& mode, double histogram_padding, double eps,
                         double min_width) {
  PRED_CHECK(mode == "exact" || mode == "neus" || mode == "nerfstudio", op,
             ": mode must be exact, neus or nerfstudio, got ", mode);
  const PdfMode found = mode == "exact" ? PdfMode::kExact : mode == "neus" ? PdfMode::kNeus : PdfMode::kNerfstudio;
  return {found, T(histogram_padding), T(eps), T(min_width)};
}

}  // namespace pred
