/* The pinhole camera with OpenCV's distortion (calib3d documentation, "Detailed Description"), there and back. */
#include "kernels.h"

#define UNDISTORT_ROUNDS 50
#define UNDISTORT_UNTIL 1e-15
/* A whole step of Newton so short leaves about its square. */
#define LAST_STEP 1e-9

void distorted(const Camera *c, double x, double y, double *px, double *by_ray) {
  double r2 = x * x + y * y, r4 = r2 * r2, r6 = r4 * r2;
  double top = 1 + c->k1 * r2 + c->k2 * r4 + c->k3 * r6, bottom = 1 + c->k4 * r2 + c->k5 * r4 + c->k6 * r6;
  double radial = top / bottom;
  double xy = 2 * x * y, xx = r2 + 2 * x * x, yy = r2 + 2 * y * y;
  double u = x * radial + c->p1 * xy + c->p2 * xx + c->s1 * r2 + c->s2 * r4;
  double v = y * radial + c->p1 * yy + c->p2 * xy + c->s3 * r2 + c->s4 * r4;
  const double *t = c->tilt;
  double a = t[0] * u + t[1] * v + t[2], b = t[3] * u + t[4] * v + t[5], d = t[6] * u + t[7] * v + t[8];
  double over = d != 0 ? 1 / d : 1;
  px[0] = c->fx * (a * over) + c->skew * (b * over) + c->cx;
  px[1] = c->fy * (b * over) + c->cy;
  if (!by_ray) return;
  double by_r2 = ((c->k1 + 2 * c->k2 * r2 + 3 * c->k3 * r4) - radial * (c->k4 + 2 * c->k5 * r2 + 3 * c->k6 * r4)) / bottom;
  double ux = radial + 2 * x * x * by_r2 + 2 * c->p1 * y + 6 * c->p2 * x + 2 * x * (c->s1 + 2 * c->s2 * r2);
  double uy = 2 * x * y * by_r2 + 2 * c->p1 * x + 2 * c->p2 * y + 2 * y * (c->s1 + 2 * c->s2 * r2);
  double vx = 2 * x * y * by_r2 + 2 * c->p1 * x + 2 * c->p2 * y + 2 * x * (c->s3 + 2 * c->s4 * r2);
  double vy = radial + 2 * y * y * by_r2 + 6 * c->p1 * y + 2 * c->p2 * x + 2 * y * (c->s3 + 2 * c->s4 * r2);
  double au = (t[0] - a * over * t[6]) * over, av = (t[1] - a * over * t[7]) * over;
  double bu = (t[3] - b * over * t[6]) * over, bv = (t[4] - b * over * t[7]) * over;
  double ax = au * ux + av * vx, ay = au * uy + av * vy, bx = bu * ux + bv * vx, by = bu * uy + bv * vy;
  by_ray[0] = c->fx * ax + c->skew * bx, by_ray[1] = c->fx * ay + c->skew * by;
  by_ray[2] = c->fy * bx, by_ray[3] = c->fy * by;
}

void ray_of(const Camera *c, const double *px, double *ray) {
  double y = (px[1] - c->cy) / c->fy, x = (px[0] - c->cx - c->skew * y) / c->fx;
  double here[2], j[4];
  distorted(c, x, y, here, j);
  for (int round = 0; round < UNDISTORT_ROUNDS; round++) {
    double du = px[0] - here[0], dv = px[1] - here[1], determinant = j[0] * j[3] - j[1] * j[2];
    if (determinant == 0) break;
    double dx = (j[3] * du - j[1] * dv) / determinant, dy = (j[0] * dv - j[2] * du) / determinant;
    double off = du * du + dv * dv, share = 1;
    /* Strong distortion bends: a step that leads away is shortened. */
    for (int halving = 0; halving < 8; halving++, share /= 2) {
      distorted(c, x + share * dx, y + share * dy, here, j);
      double left = (px[0] - here[0]) * (px[0] - here[0]) + (px[1] - here[1]) * (px[1] - here[1]);
      if (left < off || off < 1e-20) break;
    }
    x += share * dx, y += share * dy;
    double until = share < 1 ? UNDISTORT_UNTIL : LAST_STEP;
    if (share * share * (dx * dx + dy * dy) < until * until * (1 + x * x + y * y)) break;
  }
  ray[0] = x, ray[1] = y;
}

/* Raw pixels (n, 2) of points (n, 3) in the camera's own frame. */
EXPORT void project(const Camera *c, const double *points_mm, int64_t n, double *pixels) {
  for (int64_t i = 0; i < n; i++) {
    const double *p = points_mm + 3 * i;
    /* As OpenCV has it, a point in the plane of the lens has no depth to divide by. */
    double over = p[2] != 0 ? 1 / p[2] : 1;
    distorted(c, p[0] * over, p[1] * over, pixels + 2 * i, 0);
  }
}

/* Rays (n, 2), x / z and y / z, of raw pixels (n, 2). */
EXPORT void normalize(const Camera *c, const double *pixels, int64_t n, double *rays) {
  for (int64_t i = 0; i < n; i++) ray_of(c, pixels + 2 * i, rays + 2 * i);
}

/* Whether this processor has what the library for x86-64-v3 (System V psABI) needs. */
EXPORT int has_x86_64_v3(void) {
#if defined(__x86_64__)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
  return 0;
#endif
}
