// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// pred._host: torch-free, NumPy-facing code for data-loader workers.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>

namespace py = pybind11;

namespace {

using FloatArray = py::array_t<float, py::array::c_style>;
using DoubleArray = py::array_t<double, py::array::c_style>;

// One pass over a sweep: drops the ego vehicle's own returns, moves the rest into the keyframe's LiDAR
// frame and writes (x, y, z, intensity, time lag). See pred.data.sweeps.place_sweep for the contract.
py::tuple place_sweep(const FloatArray& points, const DoubleArray& transform, const DoubleArray& ego_box, float lag_s) {
  if (points.ndim() != 2 || points.shape(1) < 4)
    throw std::invalid_argument("place_sweep: points must have shape [N, >=4]");
  if (transform.ndim() != 2 || transform.shape(0) != 4 || transform.shape(1) != 4)
    throw std::invalid_argument("place_sweep: transform must have shape [4, 4]");
  if (ego_box.ndim() != 1 || ego_box.shape(0) != 4)
    throw std::invalid_argument("place_sweep: ego_box must have shape [4]");
  const int64_t num_points = points.shape(0), columns = points.shape(1);
  const float* in = points.data();
  const double* t = transform.data();
  const double* box = ego_box.data();
  const auto is_ego = [&](const float* p) { return p[0] > box[0] && p[0] < box[2] && p[1] > box[1] && p[1] < box[3]; };
  int64_t kept = 0;
  for (int64_t i = 0; i < num_points; ++i) kept += !is_ego(in + i * columns);
  FloatArray placed({kept, int64_t(5)});
  py::array_t<int64_t> index(kept);
  float* out = placed.mutable_data();
  int64_t* out_index = index.mutable_data();
  for (int64_t i = 0; i < num_points; ++i) {
    const float* p = in + i * columns;
    if (is_ego(p)) continue;
    for (int row = 0; row < 3; ++row) {
      out[row] = float(t[4 * row] * p[0] + t[4 * row + 1] * p[1] + t[4 * row + 2] * p[2] + t[4 * row + 3]);
    }
    out[3] = p[3];
    out[4] = lag_s;
    out += 5;
    *out_index++ = i;
  }
  return py::make_tuple(placed, index);
}

}  // namespace

PYBIND11_MODULE(_host, m) {
  m.doc() = "Torch-free host code for data-loader workers.";
  m.def("place_sweep", &place_sweep, py::arg("points"), py::arg("transform"), py::arg("ego_box"), py::arg("lag_s"));
}
