// A pinhole camera, with the values that projection derives from it.
#pragma once

#include "layout/image.hpp"

namespace splatmill {

struct Camera {
  int width = 0, height = 0;  // pixels
  float fx = 0, fy = 0, cx = 0, cy = 0;
  float R[9] = {}, t[3] = {};     // world to camera
  float center[3] = {};           // -R^T t
  float low_u = 0, high_u = 0;    // bounds of x/z in the Jacobian: 15 % of the image beyond its edges
  float low_v = 0, high_v = 0;
  float near = 0.01f;             // world units
  bool antialias = false;

  int columns() const { return tiles_across(width); }
  int rows() const { return tiles_across(height); }
};

// viewmat [4,4] row-major, K [3,3] row-major without skew.
inline Camera make_camera(const float* viewmat, const float* K, int width, int height, float near, bool antialias) {
  Camera c;
  c.width = width;
  c.height = height;
  c.fx = K[0], c.cx = K[2], c.fy = K[4], c.cy = K[5];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.R[3 * i + j] = viewmat[4 * i + j];
    c.t[i] = viewmat[4 * i + 3];
  }
  for (int j = 0; j < 3; ++j) {
    double s = 0;
    for (int i = 0; i < 3; ++i) s -= static_cast<double>(c.R[3 * i + j]) * c.t[i];
    c.center[j] = static_cast<float>(s);
  }
  c.low_u = -(0.15f * width + c.cx) / c.fx;
  c.high_u = (1.15f * width - c.cx) / c.fx;
  c.low_v = -(0.15f * height + c.cy) / c.fy;
  c.high_v = (1.15f * height - c.cy) / c.fy;
  c.near = near;
  c.antialias = antialias;
  return c;
}

}  // namespace splatmill
