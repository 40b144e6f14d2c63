// The projection of sixteen Gaussians into one camera, and its gradient, as `project` and the fused step compute them.
//
// Covariance factor M = J W R S (2x3), Sigma' = M M^T + 0.3 I (EWA splatting, Zwicker et al. 2002), determinant by Cauchy-Binet:
// a c - b^2 would lose every digit for needles.
#pragma once

#include "layout/camera.hpp"
#include "layout/layout.hpp"
#include "projection/harmonics.hpp"
#include "simd/math.hpp"

namespace splatmill {

struct Projection {
  Float x, y, z, inv_z;        // camera space
  Float u, v;                  // x/z, y/z
  Float u_held, v_held;        // u and v within the camera's bounds, for the Jacobian
  Mask u_free, v_free;         // where u and v lie within the bounds
  Float scale[3], R[3][3];
  Float quat[4], quat_inv;     // unit quaternion; 1 / norm
  Float T0[3], T1[3];          // rows of J W
  Float M0[3], M1[3];          // rows of M
  Float a, b, c, det;          // Sigma' (pixels^2) and its determinant
  Float sigmoid, opacity;      // before and after the antialias compensation
  Float complement;            // 1 - sigmoid, without cancellation
  Float x2d, y2d;              // pixels
  Float cut;                   // log2(255 opacity)
  Float extent_x, extent_y;    // pixels
  Mask visible;
};

// Projects the block of parameters `p`, all but its colour, whose test `visible` still lacks.
SPLATMILL_INLINE void project_geometry(const float* p, const Camera& cam, Projection& o) {
  const Float X = row(p, kMean), Y = row(p, kMean + 1), Z = row(p, kMean + 2);
  o.x = fma(cam.R[0], X, fma(cam.R[1], Y, fma(cam.R[2], Z, splat(cam.t[0]))));
  o.y = fma(cam.R[3], X, fma(cam.R[4], Y, fma(cam.R[5], Z, splat(cam.t[1]))));
  o.z = fma(cam.R[6], X, fma(cam.R[7], Y, fma(cam.R[8], Z, splat(cam.t[2]))));
  o.visible = (o.z > cam.near) & is_finite(o.z);
  o.inv_z = 1.0f / o.z;
  o.u = o.x * o.inv_z;
  o.v = o.y * o.inv_z;
  o.u_held = min(max(o.u, cam.low_u), cam.high_u);
  o.v_held = min(max(o.v, cam.low_v), cam.high_v);
  o.u_free = o.u_held == o.u;
  o.v_free = o.v_held == o.v;

  Float not_finite = row(p, kLogit) * 0.0f;  // stays 0 unless something below is NaN or infinite
  for (int j = 0; j < 3; ++j) {
    const Float log_scale = row(p, kLogScale + j);
    o.scale[j] = exp(log_scale);
    not_finite = fma(log_scale, splat(0.0f), not_finite);
  }
  o.visible &= not_finite == 0.0f;

  // Divided by the largest component first: the square of 1e-30 is 0 in float32, that of 1e30 infinite.
  Float q[4], largest = splat(0.0f);
  for (int i = 0; i < 4; ++i) {
    q[i] = row(p, kQuat + i);
    largest = max(abs(q[i]), largest);
  }
  Float norm2 = splat(0.0f);
  for (int i = 0; i < 4; ++i) {
    q[i] = q[i] / largest;
    norm2 = fma(q[i], q[i], norm2);
  }
  const Float inv_norm = 1.0f / sqrt(norm2);
  o.quat_inv = inv_norm / largest;
  for (int i = 0; i < 4; ++i) o.quat[i] = q[i] * inv_norm;
  const Float w = o.quat[0], i = o.quat[1], j = o.quat[2], k = o.quat[3];
  const Float ii = i + i, jj = j + j, kk = k + k;
  o.R[0][0] = fnma(jj, j, fnma(kk, k, splat(1.0f)));
  o.R[0][1] = fnma(w, kk, ii * j);
  o.R[0][2] = fma(w, jj, ii * k);
  o.R[1][0] = fma(w, kk, ii * j);
  o.R[1][1] = fnma(ii, i, fnma(kk, k, splat(1.0f)));
  o.R[1][2] = fnma(w, ii, jj * k);
  o.R[2][0] = fnma(w, jj, ii * k);
  o.R[2][1] = fma(w, ii, jj * k);
  o.R[2][2] = fnma(ii, i, fnma(jj, j, splat(1.0f)));

  const Float fx_z = cam.fx * o.inv_z, fy_z = cam.fy * o.inv_z;
  for (int n = 0; n < 3; ++n) {
    o.T0[n] = fx_z * fnma(o.u_held, splat(cam.R[6 + n]), splat(cam.R[n]));
    o.T1[n] = fy_z * fnma(o.v_held, splat(cam.R[6 + n]), splat(cam.R[3 + n]));
  }
  Float trace0 = splat(0.0f), trace1 = splat(0.0f);
  o.b = splat(0.0f);
  for (int n = 0; n < 3; ++n) {
    o.M0[n] = fma(o.T0[0], o.R[0][n], fma(o.T0[1], o.R[1][n], o.T0[2] * o.R[2][n])) * o.scale[n];
    o.M1[n] = fma(o.T1[0], o.R[0][n], fma(o.T1[1], o.R[1][n], o.T1[2] * o.R[2][n])) * o.scale[n];
    trace0 = fma(o.M0[n], o.M0[n], trace0);
    trace1 = fma(o.M1[n], o.M1[n], trace1);
    o.b = fma(o.M0[n], o.M1[n], o.b);
  }
  o.a = trace0 + kBlur;
  o.c = trace1 + kBlur;
  const Float minor0 = o.M0[1] * o.M1[2] - o.M0[2] * o.M1[1];
  const Float minor1 = o.M0[2] * o.M1[0] - o.M0[0] * o.M1[2];
  const Float minor2 = o.M0[0] * o.M1[1] - o.M0[1] * o.M1[0];
  const Float sharp = fma(minor0, minor0, fma(minor1, minor1, minor2 * minor2));
  o.det = fma(kBlur, trace0 + trace1, sharp) + kBlur * kBlur;
  o.visible &= is_finite(o.det) & is_finite(o.a) & is_finite(o.c);  // b is bounded by both

  const Float odds_against = exp(-row(p, kLogit));
  o.sigmoid = 1.0f / (odds_against + 1.0f);
  o.complement = odds_against * o.sigmoid;  // 1 - sigmoid cancels: beyond a logit of 10 few of its digits are right
  o.opacity = o.sigmoid;
  // Detached from the covariance: through det, the gradient explodes for splats that degenerate, and drives others there.
  if (cam.antialias) o.opacity = o.opacity * sqrt(max(sharp / o.det, kCompensationMin));
  o.visible &= o.opacity > kAlphaMin;
  o.cut = log2(max(o.opacity, kAlphaMin)) - kLog2AlphaMin;
  const Float reach2 = max(o.cut * (2.0f * kLn2), 0.0f);  // squared standard deviations of the 1/255 ellipse
  o.extent_x = sqrt(reach2 * o.a);
  o.extent_y = sqrt(reach2 * o.c);
  o.x2d = fma(cam.fx, o.u, splat(cam.cx));
  o.y2d = fma(cam.fy, o.v, splat(cam.cy));
  o.visible &= (o.x2d + o.extent_x > 0.0f) & (o.x2d - o.extent_x < static_cast<float>(cam.width)) &
               (o.y2d + o.extent_y > 0.0f) & (o.y2d - o.extent_y < static_cast<float>(cam.height)) &
               (o.extent_x > 0.0f);
}

// The unit direction from the camera to the mean, and 1 / distance.
SPLATMILL_INLINE Direction view_direction(const float* p, const Camera& cam, Float& inv_distance) {
  const Float dx = row(p, kMean) - cam.center[0], dy = row(p, kMean + 1) - cam.center[1],
              dz = row(p, kMean + 2) - cam.center[2];
  inv_distance = 1.0f / sqrt(fma(dx, dx, fma(dy, dy, dz * dz)));
  return {dx * inv_distance, dy * inv_distance, dz * inv_distance};
}

// Colour before the clamp at 0.
SPLATMILL_INLINE void sh_color(const float* p, const Float* basis, int degree, Float* color) {
  for (int c = 0; c < 3; ++c) color[c] = splat(0.5f);
  const int n = (degree + 1) * (degree + 1);
  for (int k = 0; k < n; ++k)
    for (int c = 0; c < 3; ++c) color[c] = fma(basis[k], row(p, kSh + 3 * k + c), color[c]);
}

// The triangular factor of the conic as a Record holds it: level - u^2 - v^2 = log2 alpha.
struct Factor {
  Float ux, uy, vy;
};
SPLATMILL_INLINE Factor conic_factor(const Float& b, const Float& c, const Float& det) {
  const Float half = splat(0.5f * kLog2E);
  const Float ux = sqrt(half * (c / det));
  return {ux, -(ux * (b / c)), sqrt(half / c)};
}

// The gradient to a projected Gaussian.
struct ProjectedGradient {
  Float x2d, y2d;        // to the 2-D mean, 1 / pixels
  Float Quu, Quv, Qvv;   // to Sigma': dL/dSigma' = F^T Q F with the factor F of the conic; nothing cancels for needles
  Float logit;           // to the logit of the opacity
  Float color[3];        // to the clamped colour
  Float depth;
};

// The gradient to the camera, by lane.
struct CameraGradient {
  Float R[9], t[3];
};

// Writes the rows of g[kRows][kLanes] up to the active degree; other rows keep what they hold. Lanes that are not visible get
// meaningless values. With kCamera, also writes the gradient to the camera.
template <bool kCamera>
SPLATMILL_INLINE void project_backward(const float* p, const Camera& cam, int degree, const Projection& o,
                                       const ProjectedGradient& d, float* g, CameraGradient* camera) {
  store(g + kLogit * kLanes, d.logit);

  // Sigma' = M M^T + 0.3 I, M = T R S, so dL/dM = 2 F^T Q (F M). For a needle F M is small where M is large: its first row,
  // ux (m0 - b/c m1), is taken as ux/c (0.3 m0 + m1 x minors), in which nothing cancels.
  const Factor f = conic_factor(o.b, o.c, o.det);
  const Float minor[3] = {o.M0[1] * o.M1[2] - o.M0[2] * o.M1[1], o.M0[2] * o.M1[0] - o.M0[0] * o.M1[2],
                          o.M0[0] * o.M1[1] - o.M0[1] * o.M1[0]};
  const Float ux_c = f.ux / o.c;
  Float dT0[3], dT1[3], dR[3][3], with_scale = splat(0.0f);
  for (int n = 0; n < 3; ++n) dT0[n] = dT1[n] = splat(0.0f);
  for (int n = 0; n < 3; ++n) {
    const int n1 = (n + 1) % 3, n2 = (n + 2) % 3;
    const Float u = ux_c * fma(kBlur, o.M0[n], o.M1[n1] * minor[n2] - o.M1[n2] * minor[n1]), v = f.vy * o.M1[n];
    const Float to_u = fma(d.Quu, u, d.Quv * v) * 2.0f, to_v = fma(d.Quv, u, d.Qvv * v) * 2.0f;
    const Float dM0 = f.ux * to_u, dM1 = fma(f.uy, to_u, f.vy * to_v);
    const Float d_log_scale = fma(u, to_u, v * to_v);
    with_scale += d_log_scale;
    for (int m = 0; m < 3; ++m) {
      const Float rs = o.R[m][n] * o.scale[n];
      const Float dF = fma(o.T0[m], dM0, o.T1[m] * dM1);  // to (R S)[m][n]
      dR[m][n] = dF * o.scale[n];
      dT0[m] = fma(dM0, rs, dT0[m]);
      dT1[m] = fma(dM1, rs, dT1[m]);
    }
    store(g + (kLogScale + n) * kLanes, d_log_scale);
  }

  // Unit quaternion, then its normalisation.
  const Float w = o.quat[0], i = o.quat[1], j = o.quat[2], k = o.quat[3];
  const Float a0 = dR[2][1] - dR[1][2], a1 = dR[0][2] - dR[2][0], a2 = dR[1][0] - dR[0][1];
  const Float s01 = dR[0][1] + dR[1][0], s02 = dR[0][2] + dR[2][0], s12 = dR[1][2] + dR[2][1];
  Float dq[4];
  dq[0] = fma(i, a0, fma(j, a1, k * a2)) * 2.0f;
  dq[1] = (fma(j, s01, fma(k, s02, w * a0)) - i * (dR[1][1] + dR[2][2]) * 2.0f) * 2.0f;
  dq[2] = (fma(i, s01, fma(k, s12, w * a1)) - j * (dR[0][0] + dR[2][2]) * 2.0f) * 2.0f;
  dq[3] = (fma(i, s02, fma(j, s12, w * a2)) - k * (dR[0][0] + dR[1][1]) * 2.0f) * 2.0f;
  const Float along = fma(dq[0], w, fma(dq[1], i, fma(dq[2], j, dq[3] * k)));
  for (int n = 0; n < 4; ++n) store(g + (kQuat + n) * kLanes, fnma(along, o.quat[n], dq[n]) * o.quat_inv);

  // T0 = fx/z (W0 - u W2), T1 = fy/z (W1 - v W2); the 2-D mean uses u, v unheld.
  const Float fx_z = cam.fx * o.inv_z, fy_z = cam.fy * o.inv_z;
  const Float held_u = fma(dT0[0], splat(cam.R[6]), fma(dT0[1], splat(cam.R[7]), dT0[2] * cam.R[8])) * fx_z;
  const Float held_v = fma(dT1[0], splat(cam.R[6]), fma(dT1[1], splat(cam.R[7]), dT1[2] * cam.R[8])) * fy_z;
  const Float du = cam.fx * d.x2d - keep(o.u_free, held_u);
  const Float dv = cam.fy * d.y2d - keep(o.v_free, held_v);
  // 1/z scales T, and with it M, as the three scales together do.
  const Float with_inv_z = fma(du, o.u, fma(dv, o.v, with_scale));
  const Float dx = du * o.inv_z, dy = dv * o.inv_z, dz = fnma(with_inv_z, o.inv_z, d.depth);
  Float d_mean[3];
  for (int n = 0; n < 3; ++n)
    d_mean[n] = fma(cam.R[n], dx, fma(cam.R[3 + n], dy, cam.R[6 + n] * dz));

  // Colour: coefficients, and the direction they are seen from.
  Float inv_distance, basis[16], color[3], e[16];
  const Direction dir = view_direction(p, cam, inv_distance);
  sh_basis(degree, dir, basis);
  sh_color(p, basis, degree, color);
  Float d_color[3];
  for (int c = 0; c < 3; ++c) d_color[c] = keep(color[c] >= 0.0f, d.color[c]);
  const int n_basis = (degree + 1) * (degree + 1);
  for (int n = 0; n < n_basis; ++n) {
    const int r = kSh + 3 * n;
    e[n] = fma(d_color[0], row(p, r), fma(d_color[1], row(p, r + 1), d_color[2] * row(p, r + 2)));
    for (int c = 0; c < 3; ++c) store(g + (kSh + 3 * n + c) * kLanes, basis[n] * d_color[c]);
  }
  const Direction dd = sh_basis_backward(degree, dir, e);
  const Float radial = fma(dd.x, dir.x, fma(dd.y, dir.y, dd.z * dir.z));
  const Float d_offset[3] = {fnma(radial, dir.x, dd.x) * inv_distance, fnma(radial, dir.y, dd.y) * inv_distance,
                             fnma(radial, dir.z, dd.z) * inv_distance};
  for (int n = 0; n < 3; ++n) store(g + (kMean + n) * kLanes, d_mean[n] + d_offset[n]);

  if constexpr (kCamera) {
    const Float mean[3] = {row(p, kMean), row(p, kMean + 1), row(p, kMean + 2)};
    const Float d_point[3] = {dx, dy, dz};
    for (int m = 0; m < 3; ++m) {
      camera->t[m] = d_point[m];
      for (int n = 0; n < 3; ++n) {
        // point = R mean + t, and offset = mean + R^T t
        camera->R[3 * m + n] = fma(d_point[m], mean[n], d_offset[n] * cam.t[m]);
        camera->t[m] = fma(cam.R[3 * m + n], d_offset[n], camera->t[m]);
      }
    }
    for (int n = 0; n < 3; ++n) {
      camera->R[n] = fma(fx_z, dT0[n], camera->R[n]);
      camera->R[3 + n] = fma(fy_z, dT1[n], camera->R[3 + n]);
      camera->R[6 + n] -= fx_z * o.u_held * dT0[n] + fy_z * o.v_held * dT1[n];
    }
  }
}

}  // namespace splatmill
