// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Instruction-set levels of the CPU kernels.
//
// Every ops/<op>_cpu.cpp is compiled once per level, with PRED_ISA naming the level's namespace. It
// defines a table of function pointers there; the binding picks a table with PRED_KERNELS(name).
#pragma once

namespace pred {

enum class Isa { kDefault, kAvx2, kAvx512, kAvx512Bf16 };

// The level in force: the best one this build and this CPU have, or what PRED_CPU_CAPABILITY asks
// for. Throws std::invalid_argument for an unknown name or one that this CPU or build lacks.
Isa active_isa();

const char* isa_name(Isa isa);

}  // namespace pred

#if !defined(PRED_NUM_LEVELS) || PRED_NUM_LEVELS == 4
#define PRED_DECLARE_KERNELS(Table, name) \
  namespace pred::isa_default {           \
  extern const Table name;                \
  }                                       \
  namespace pred::isa_avx2 {              \
  extern const Table name;                \
  }                                       \
  namespace pred::isa_avx512 {            \
  extern const Table name;                \
  }                                       \
  namespace pred::isa_avx512_bf16 {       \
  extern const Table name;                \
  }
#define PRED_KERNELS(name)                                                          \
  (::pred::active_isa() == ::pred::Isa::kAvx512Bf16 ? ::pred::isa_avx512_bf16::name \
   : ::pred::active_isa() == ::pred::Isa::kAvx512   ? ::pred::isa_avx512::name      \
   : ::pred::active_isa() == ::pred::Isa::kAvx2     ? ::pred::isa_avx2::name        \
                                                    : ::pred::isa_default::name)
#else
#define PRED_DECLARE_KERNELS(Table, name) \
  namespace pred::isa_default {           \
  extern const Table name;                \
  }
#define PRED_KERNELS(name) (::pred::active_isa(), ::pred::isa_default::name)
#endif
