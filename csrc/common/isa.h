// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Instruction-set levels of the CPU kernels.
//
// Every ops/<op>_cpu.cpp is compiled once per level, with PRED_ISA naming the level's namespace. It
// defines a table of function pointers there; the binding picks a table with PRED_KERNELS(name).
#pragma once

#include <type_traits>

namespace pred {

enum class Isa { kDefault, kAvx2, kAvx512, kAvx512Bf16 };

// The level in force: the best one this build and this CPU have, or what PRED_CPU_CAPABILITY asks
// for. Throws std::invalid_argument for an unknown name or one that this CPU or build lacks.
Isa active_isa();

const char* isa_name(Isa isa);

template <class Table>
const Table& pick(Isa isa, const Table& baseline, const Table& avx2, const Table& avx512, const Table& avx512_bf16) {
  switch (isa) {
    case Isa::kAvx512Bf16:
      return avx512_bf16;
    case Isa::kAvx512:
      return avx512;
    case Isa::kAvx2:
      return avx2;
    default:
      return baseline;
  }
}

}  // namespace pred

#ifdef PRED_LAUNCH
// Kernels that are launched (common/device.h) have one table.
#define PRED_DECLARE_KERNELS(Table, name) \
  namespace pred::device {                \
  extern const Table name;                \
  }
#define PRED_KERNELS(name) (::pred::device::name)
#elif !defined(PRED_NUM_LEVELS) || PRED_NUM_LEVELS == 4
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
#define PRED_KERNELS(name)                                                                                         \
  (::pred::pick(::pred::active_isa(), ::pred::isa_default::name, ::pred::isa_avx2::name, ::pred::isa_avx512::name, \
                ::pred::isa_avx512_bf16::name))
#else
#define PRED_DECLARE_KERNELS(Table, name) \
  namespace pred::isa_default {           \
  extern const Table name;                \
  }
#define PRED_KERNELS(name) (::pred::active_isa(), ::pred::isa_default::name)
#endif

// Defines name_kernels<T>(): the table name_f32 or name_f64 of the level in force.
#define PRED_KERNELS_BY_TYPE(Table, name)   \
  template <typename T>                     \
  const Table<T>& name##_kernels() {        \
    if constexpr (std::is_same_v<T, float>) \
      return PRED_KERNELS(name##_f32);      \
    else                                    \
      return PRED_KERNELS(name##_f64);      \
  }

// The same for tables by the type of products' operands: name_f32, name_f64 or name_bf16.
#define PRED_KERNELS_BY_FACTOR(Table, name)       \
  template <typename S>                           \
  const Table<S>& name##_kernels() {              \
    if constexpr (std::is_same_v<S, float>)       \
      return PRED_KERNELS(name##_f32);            \
    else if constexpr (std::is_same_v<S, double>) \
      return PRED_KERNELS(name##_f64);            \
    else                                          \
      return PRED_KERNELS(name##_bf16);           \
  }

// The same for tables by storage type (math/half.h): name_f32, name_f64, name_bf16 or name_f16.
#define PRED_KERNELS_BY_STORAGE(Table, name)        \
  template <typename S>                             \
  const Table<S>& name##_kernels() {                \
    if constexpr (std::is_same_v<S, float>)         \
      return PRED_KERNELS(name##_f32);              \
    else if constexpr (std::is_same_v<S, double>)   \
      return PRED_KERNELS(name##_f64);              \
    else if constexpr (std::is_same_v<S, BFloat16>) \
      return PRED_KERNELS(name##_bf16);             \
    else                                            \
      return PRED_KERNELS(name##_f16);              \
  }
