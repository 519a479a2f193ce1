// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "emulation/cuda.h"

#include <sys/mman.h>

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <new>
#include <numeric>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

// Saves the stack pointer of the running thread, all of whose other state is on its stack, and goes on with another's:
// what swapcontext does, without its two system calls. (System V ABI of x86-64; the modes of floating point are one.)
extern "C" __attribute__((visibility("hidden"))) void pred_switch_stack(void** from, void* to);
asm(R"(
.text
.p2align 4
.hidden pred_switch_stack
.globl pred_switch_stack
.type pred_switch_stack, @function
pred_switch_stack:
  pushq %rbp
  pushq %rbx
  pushq %r12
  pushq %r13
  pushq %r14
  pushq %r15
  movq %rsp, (%rdi)
  movq %rsi, %rsp
  popq %r15
  popq %r14
  popq %r13
  popq %r12
  popq %rbx
  popq %rbp
  ret
.size pred_switch_stack, .-pred_switch_stack
)");

namespace pred::emulation {

Place place;

namespace {

constexpr unsigned kWarp = 32, kMostThreads = 1024;
constexpr size_t kStackBytes = 256 * 1024;

// Arrivals since the last time that all were there, and how often that was.
struct Barrier {
  unsigned arrived = 0;
  uint64_t rounds = 0;
};

struct Warp {
  Barrier barrier;
  uint64_t lanes[2][kWarp];
  unsigned side[kWarp];  // of `lanes` that a lane writes next
};

struct Thread {
  void* stack;
  const Barrier* waits_at;
  uint64_t round;
  bool ended;
};

struct Stacks {
  char* memory;
  Stacks() {
    void* mapped = mmap(nullptr, kMostThreads * kStackBytes, PROT_READ | PROT_WRITE,
                        MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (mapped == MAP_FAILED) throw std::bad_alloc();
    memory = static_cast<char*>(mapped);
  }
};

void* scheduler;  // its stack
std::vector<Thread> threads;
std::vector<Warp> warps;
Barrier block_barrier;
std::vector<char> shared_memory;
const std::function<void()>* running_kernel;

Thread& running() { return threads[place.thread.x]; }

void wait(Barrier& barrier, unsigned expected) {
  if (++barrier.arrived == expected) {
    barrier.arrived = 0;
    ++barrier.rounds;
    return;
  }
  Thread& thread = running();
  thread.waits_at = &barrier;
  thread.round = barrier.rounds;
  pred_switch_stack(&thread.stack, scheduler);
}

[[noreturn]] void run_thread() {
  (*running_kernel)();
  running().ended = true;
  pred_switch_stack(&running().stack, scheduler);
  __builtin_unreachable();
}

// A stack on which pred_switch_stack finds six registers and run_thread to return to.
void* new_stack(char* memory) {
  void** top = reinterpret_cast<void**>(memory + kStackBytes);
  top[-2] = reinterpret_cast<void*>(&run_thread);
  std::fill(top - 8, top - 2, nullptr);
  return top - 8;
}

std::vector<unsigned> order_of(unsigned count) {
  const char* wanted = std::getenv("PRED_EMULATION_ORDER");
  const std::string name = wanted == nullptr || *wanted == '\0' ? "forward" : wanted;
  std::vector<unsigned> order(count);
  std::iota(order.begin(), order.end(), 0u);
  if (name == "backward") {
    std::reverse(order.begin(), order.end());
  } else if (name == "shuffled") {
    std::shuffle(order.begin(), order.end(), std::mt19937(count));
  } else if (name != "forward") {
    throw std::invalid_argument("PRED_EMULATION_ORDER must be forward, backward or shuffled, got " + name);
  }
  return order;
}

void run_block(const std::vector<unsigned>& order, char* stacks) {
  const unsigned count = unsigned(order.size());
  warps.assign(count / kWarp, Warp{});
  block_barrier = Barrier{};
  for (unsigned i = 0; i < count; ++i) {
    Thread& thread = threads[i];
    thread.waits_at = nullptr;
    thread.ended = false;
    thread.stack = new_stack(stacks + i * kStackBytes);
  }
  for (unsigned left = count; left > 0;) {
    bool moved = false;
    for (const unsigned i : order) {
      Thread& thread = threads[i];
      if (thread.ended || (thread.waits_at != nullptr && thread.waits_at->rounds == thread.round)) continue;
      thread.waits_at = nullptr;
      place.thread = {i};
      pred_switch_stack(&scheduler, thread.stack);
      moved = true;
      if (thread.ended) --left;
    }
    if (!moved) {
      throw std::runtime_error("pred: emulated kernel: " + std::to_string(left) + " threads of block " +
                               std::to_string(place.block.x) + " wait at barriers that others do not reach");
    }
  }
}

}  // namespace

void run(unsigned blocks, unsigned num_threads, int64_t shared_bytes, const std::function<void()>& kernel) {
  static std::mutex one_at_a_time;
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  static const Stacks stacks;
  if (num_threads == 0 || num_threads > kMostThreads || num_threads % kWarp != 0) {
    throw std::runtime_error("pred: emulated kernel: blocks must have 32 to 1024 threads in whole warps, got " +
                             std::to_string(num_threads));
  }
  const std::vector<unsigned> order = order_of(num_threads);
  threads.resize(std::max<size_t>(threads.size(), num_threads));
  shared_memory.assign(size_t(shared_bytes), 0x7f);  // not 0, which would hide what is not written
  running_kernel = &kernel;
  place.block_size = {num_threads};
  place.grid_size = {blocks};
  for (unsigned block = 0; block < blocks; ++block) {
    place.block = {block};
    run_block(order, stacks.memory);
  }
}

void* dynamic_shared_memory() { return shared_memory.data(); }

void wait_for_block() { wait(block_barrier, place.block_size.x); }

void wait_for_warp() { wait(warps[place.thread.x / kWarp].barrier, kWarp); }

const uint64_t* exchange(uint64_t value) {
  Warp& warp = warps[place.thread.x / kWarp];
  const unsigned lane = place.thread.x % kWarp, side = warp.side[lane];
  warp.side[lane] = 1 - side;
  warp.lanes[side][lane] = value;
  wait_for_warp();
  return warp.lanes[side];
}

}  // namespace pred::emulation
