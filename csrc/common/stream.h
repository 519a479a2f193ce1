// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace pred {

// torch's current stream on the current device, a cudaStream_t.
void* current_stream();

}  // namespace pred
