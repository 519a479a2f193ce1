// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "common/isa.h"

#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

namespace pred {
namespace {

constexpr const char* kNames[] = {"default", "avx2", "avx512", "avx512_bf16"};

bool cpu_has(Isa isa) {
#if PRED_NUM_LEVELS == 4
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2") &&
                    __builtin_cpu_supports("f16c");
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512cd") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512vl");
  switch (isa) {
    case Isa::kDefault:
      return true;
    case Isa::kAvx2:
      return avx2;
    case Isa::kAvx512:
      return avx512;
    case Isa::kAvx512Bf16:
      return avx512 && __builtin_cpu_supports("avx512vnni") && __builtin_cpu_supports("avx512bf16");
  }
#endif
  return isa == Isa::kDefault;
}

Isa best_isa() {
  for (const Isa isa : {Isa::kAvx512Bf16, Isa::kAvx512, Isa::kAvx2}) {
    if (cpu_has(isa)) return isa;
  }
  return Isa::kDefault;
}

}  // namespace

const char* isa_name(Isa isa) { return kNames[static_cast<int>(isa)]; }

Isa active_isa() {
  static const Isa best = best_isa();
  // Read at every call, so that one process can test every level.
  const char* wanted = std::getenv("PRED_CPU_CAPABILITY");
  if (wanted == nullptr || *wanted == '\0') return best;
  for (int level = 0; level < 4; ++level) {
    if (std::strcmp(wanted, kNames[level]) != 0) continue;
    const Isa isa = static_cast<Isa>(level);
    if (cpu_has(isa)) return isa;
    throw std::invalid_argument(
        std::string("PRED_CPU_CAPABILITY must name a level that this CPU and build have, got ") + wanted +
        "; the best here is " + isa_name(best));
  }
  throw std::invalid_argument(
      std::string("PRED_CPU_CAPABILITY must be one of default, avx2, avx512, avx512_bf16, got ") + wanted);
}

}  // namespace pred
