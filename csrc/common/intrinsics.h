// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The x86 intrinsics, for kernel files, without the warnings that GCC 12 gives about its own header.
#pragma once

#if defined(__x86_64__) && !defined(__CUDACC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wuninitialized"
#ifndef __clang__
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif
#include <immintrin.h>
#pragma GCC diagnostic pop
#endif
