# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
#
#   make demo      set up, make a small world, pre-train a small model on it, draw pictures
#   make test      set up, run all tests
#   make sanitize  run the op tests under the address and undefined-behaviour sanitizers
#   make emulate   the tests of ops with CUDA kernels, on those kernels run by the CPU under the sanitizers
#   make cuda-compile  the CUDA library for all architectures, compiled and linked (needs nvcc, no GPU)
#   make test-cuda the same tests on a GPU, then compute-sanitizer on some (uses $(PYTHON) and its torch)
#   make bench-cuda the benchmark suite on a GPU: records BENCH_OUT-step.json and BENCH_OUT-ops.json
#   make fuzz      random arguments for every op under the sanitizers, for MINUTES
#   make wheel-check  the op tests of one wheel under other versions of torch (downloads gigabytes)
#   make lint      ruff, clang-format, mypy
#   make docs      the documentation site, in build/site
#   make bench     the benchmark suite
#   make format    rewrite files as lint wants them
#
# TORCH names the torch version to install into .venv; TORCH=installed keeps the one of $(PYTHON).
PYTHON ?= python3
TORCH ?= 2.13.0
VENV ?= .venv
RUN ?= runs/demo
WORLD ?= runs/demo_world
MINUTES ?= 60
SEED ?= 0
BENCH_OUT ?= benchmarks/results/gpu
# What wheel-check runs under: version of torch (or newest), colon, Python. One that is missing is an error.
WHEEL_PYTHON ?= python3.12
WHEEL_CHECKS ?= 2.11.0:$(WHEEL_PYTHON) newest:$(WHEEL_PYTHON)

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
NATIVE := $(shell find csrc -type f) CMakeLists.txt setup.py
# What nuscenes-devkit imports when its tables, maps and geometry are used; its numpy<2 pin is left aside.
DEVKIT := cachetools descartes matplotlib opencv-python-headless pyquaternion scikit-learn shapely tqdm

.PHONY: demo test sanitized sanitize emulate cuda-compile cuda-build test-cuda bench-cuda fuzz wheel-check lint format docs bench clean
.DELETE_ON_ERROR:

$(VENV)/torch-$(TORCH).stamp:
	$(PYTHON) -c "import sys; sys.exit('Python 3.10 or newer is needed, this is ' + sys.version) if sys.version_info < (3, 10) else None"
	$(PYTHON) -m venv --clear $(if $(filter installed,$(TORCH)),--system-site-packages) $(VENV)
	$(if $(filter installed,$(TORCH)),$(BIN)/python -c "import torch",$(PIP) install torch==$(TORCH))
	touch $@

# Build tools first: the editable install below does without pip's isolated build environment.
$(VENV)/native.stamp: $(VENV)/torch-$(TORCH).stamp pyproject.toml $(NATIVE)
	$(PIP) install "setuptools>=77" "cmake>=3.18" ninja "pybind11>=2.13"
	PRED_REQUIRE_NATIVE=1 $(PIP) install --no-build-isolation -e .
	touch $@

$(VENV)/dev.stamp: $(VENV)/native.stamp
	PRED_REQUIRE_NATIVE=1 $(PIP) install --no-build-isolation -e ".[dev]"
	$(PIP) install --no-deps nuscenes-devkit==1.2.0
	$(PIP) install $(DEVKIT)
	touch $@

demo: $(VENV)/native.stamp
	$(BIN)/pred world make $(WORLD) --scenes 4 --keyframes 6 --exact-labels
	if [ -e $(RUN)/config.yaml ]; then $(BIN)/pred pretrain --resume $(RUN) --data.root $(WORLD); \
	else $(BIN)/pred pretrain --config world_pillars --data.root $(WORLD) --run $(RUN); fi
	$(BIN)/pred evaluate rendering $(RUN)
	$(BIN)/pred view $(RUN)
	@echo "encoder weights: $(RUN)/encoder.pth    pictures: $(RUN)/pictures"

test: $(VENV)/dev.stamp
	PRED_REQUIRE_NATIVE=1 $(BIN)/python -m pytest

# A second copy of the package, built with the sanitizers, shadows the installed one. Leaks are not looked for: Python
# itself holds memory until it exits. Sizes that do not fit are refused, as without sanitizers.
SANITIZE := $(CURDIR)/build/sanitize
SANITIZED = PRED_TEST_SANITIZED=1 PRED_REQUIRE_NATIVE=1 \
	ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1:max_allocation_size_mb=4096 \
	LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so):$$($(CXX) -print-file-name=libubsan.so)"
sanitized: $(VENV)/dev.stamp
	rm -rf $(SANITIZE)
	PRED_SANITIZE=address,undefined PRED_REQUIRE_NATIVE=1 $(PIP) install --no-deps --no-build-isolation --target $(SANITIZE) .

sanitize: sanitized
	PYTHONPATH=$(SANITIZE) $(SANITIZED) $(BIN)/python -m pytest -p no:cacheprovider -o pythonpath="$(SANITIZE) ." \
		tests/ops tests/test_native.py tests/data/test_sweeps.py

# CUDA kernels on the CPU, in a copy of the package; csrc/emulation/cuda.h says how. ORDER is that of a block's threads.
EMULATED := $(CURDIR)/build/emulated
ORDER ?= shuffled
CUDA_OPS := ball_query composite_alpha composite_rays decode_field farthest_point_sample knn resample_rays sample_pdf \
	sdf_to_alpha segment_reduce sparse_conv voxelize voxelize_hard
CUDA_TESTS := $(CUDA_OPS:%=tests/ops/test_%.py) tests/ops/test_boxes.py tests/ops/test_composites.py tests/ops/test_sampling.py \
	tests/test_emulation.py
# What takes minutes when it is emulated: products of many rows, or again and again, and searches for many queries.
SLOW_TO_EMULATE := test_sparse_conv.py::test_gradcheck test_sparse_conv.py::test_gradients_of_many_rows_are_precise \
	test_sparse_conv.py::test_a_thousand_problems_have_the_same_bits_with_two_threads \
	test_decode_field.py::test_bitwise_equal_for_any_thread_count test_knn.py::test_bitwise_equal_for_any_thread_count
emulate: $(VENV)/dev.stamp
	rm -rf $(EMULATED)
	PRED_CUDA=emulate PRED_SANITIZE=address,undefined PRED_REQUIRE_NATIVE=1 \
		$(PIP) install --no-deps --no-build-isolation --target $(EMULATED) .
	PYTHONPATH=$(EMULATED) PRED_EMULATION_ORDER=$(ORDER) OMP_NUM_THREADS=1 $(SANITIZED) $(BIN)/python -m pytest -n auto \
		-p no:cacheprovider -o pythonpath="$(EMULATED) ." $(CUDA_TESTS) $(SLOW_TO_EMULATE:%=--deselect=tests/ops/%)

cuda-compile: $(VENV)/dev.stamp
	$(BIN)/cmake -G Ninja -S . -B build/cuda -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN))/ninja -DPRED_CUDA=ON -DPRED_HOST=OFF \
		-DPRED_TORCH_DIR=$$($(BIN)/python -c "import pathlib, torch; print(pathlib.Path(torch.__file__).parent)")
	$(BIN)/cmake --build build/cuda --target pred_cuda
	$(PIP) install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm
	PRED_TEST_CUDA_LIBRARY=build/cuda/libpred_cuda.so $(BIN)/python -m pytest tests/test_cuda_library.py

# In place, for the GPUs that are there.
cuda-build:
	PRED_CUDA=1 PRED_REQUIRE_NATIVE=1 CUDAARCHS=native $(PYTHON) setup.py -q build_ext --inplace

# PRED_TEST_DEVICE takes CPU tensors through the GPU (tests/conftest.py), here in JOBS processes; parity with the CPU is
# tested without it. These share the cores: more threads than cores wait for each other. The sanitizers look at this
# library's kernels alone; memcheck sees a tensor's end only without torch's allocator. cuBLAS, which the tests use, wants
# to be told how to repeat.
CUDA_SANITIZER := compute-sanitizer --error-exitcode 1 --target-processes all --report-api-errors no \
	--kernel-name kernel_substring=pred
JOBS ?= 4
test-cuda: export CUBLAS_WORKSPACE_CONFIG := :4096:8
test-cuda: cuda-build
	PRED_REQUIRE_NATIVE=1 $(PYTHON) -m pytest -q tests/test_cuda.py
	PRED_TEST_DEVICE=cuda PRED_REQUIRE_NATIVE=1 OMP_NUM_THREADS=$$(( ($$(nproc) + $(JOBS) - 1) / $(JOBS) )) \
		$(PYTHON) -m pytest -q -n $(JOBS) $(CUDA_TESTS)
	PYTORCH_NO_CUDA_MEMORY_CACHING=1 $(CUDA_SANITIZER) --tool memcheck \
		$(PYTHON) -m pytest -q tests/test_cuda.py -k "parity and float32"
	$(CUDA_SANITIZER) --tool racecheck $(PYTHON) -m pytest -q tests/test_cuda.py -k "parity_with and float32"

# torch.compile takes part in the rendering step alone: compiling every phase of every op would take an hour.
bench-cuda: cuda-build
	$(PYTHON) -m benchmarks --device cuda --min-time 3 --ops rendering_step --out $(BENCH_OUT)-step.json
	$(PYTHON) -m benchmarks --device cuda --quick --contenders ours,eager,peers --out $(BENCH_OUT)-ops.json

# From another folder, since python -m puts the working one, with its pred/, first on the path.
fuzz: sanitized
	cd build && PYTHONPATH=$(SANITIZE):$(CURDIR) $(SANITIZED) $(abspath $(BIN))/python -m tests.fuzz_ops \
		--minutes $(MINUTES) --seed $(SEED) --findings $(CURDIR)/build/fuzz_findings.txt

wheel-check: $(VENV)/dev.stamp
	$(BIN)/python tests/wheel_check.py $(WHEEL_CHECKS)

docs: $(VENV)/native.stamp
	PRED_REQUIRE_NATIVE=1 $(PIP) install --no-build-isolation -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(shell find csrc -name '*.h' -o -name '*.cpp' -o -name '*.cu' -o -name '*.cuh')
	$(BIN)/mypy

format: $(VENV)/dev.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(shell find csrc -name '*.h' -o -name '*.cpp' -o -name '*.cu' -o -name '*.cuh')

bench: $(VENV)/dev.stamp
	$(BIN)/python -m benchmarks

clean:
	rm -rf build $(VENV) pred/libpred_* pred/_host*.so pred/build_info.json
