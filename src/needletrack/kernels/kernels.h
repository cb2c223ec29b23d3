/* What the kernels share: the camera's layout, and mathematics that a compiler can vectorise. */
#ifndef NEEDLETRACK_KERNELS_H
#define NEEDLETRACK_KERNELS_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

/* As `needletrack.kernels.Lens` lays it out: all doubles. camera_from_world = [rotation | translation_mm]. */
typedef struct {
  double fx, fy, cx, cy, skew;
  double k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4;
  double tilt[9];
  double rotation[9], translation_mm[3];
} Camera;

/* Raw pixel of a ray (x, y, 1) in the camera's frame; by_ray, if wanted: its derivatives (2, 2). */
void distorted(const Camera *c, double x, double y, double *px, double *by_ray);
/* The ray (x, y, 1) of a raw pixel. */
void ray_of(const Camera *c, const double *px, double *ray);

/* e^x of single precision for x <= 0, to 1e-5 of itself; below -87 it is nearly 0. */
static inline float exp_negative(float x) {
  x = x < -87.0f ? -87.0f : x;
  float n = rintf(x * 1.44269504f);
  float r = x - n * 0.693147181f;
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * r * r + r + 1.0f;
  int32_t power = ((int32_t)n + 127) << 23;
  float two;
  memcpy(&two, &power, sizeof two);
  return p * two;
}

/* e^x of double precision for -700 < x <= 0, to 1e-13 of itself (Taylor's series on half of log 2 to either side). */
static inline double exp_negative_precise(double x) {
  x = x < -700 ? -700 : x;
  double n = rint(x * 1.4426950408889634);
  double r = x - n * 6.931471805599453094e-1;
  double p = 1.0 / 479001600;
  p = p * r + 1.0 / 39916800;
  p = p * r + 1.0 / 3628800;
  p = p * r + 1.0 / 362880;
  p = p * r + 1.0 / 40320;
  p = p * r + 1.0 / 5040;
  p = p * r + 1.0 / 720;
  p = p * r + 1.0 / 120;
  p = p * r + 1.0 / 24;
  p = p * r + 1.0 / 6;
  p = p * r + 0.5;
  p = p * r * r + r + 1.0;
  int64_t power = (int64_t)((int32_t)n + 1023) << 52;
  double two;
  memcpy(&two, &power, sizeof two);
  return p * two;
}

/* log(1 + e^-d) of single precision for d >= 0, to 1e-6. */
static inline float log_one_plus_exp_negative(float d) {
  float e = exp_negative(-d);
  /* log1p(e) on [0, 1]: atanh series in e / (2 + e), at most 1/3. */
  float z = e / (2.0f + e), z2 = z * z;
  float p = 1.0f / 13.0f;
  p = p * z2 + 1.0f / 11.0f;
  p = p * z2 + 1.0f / 9.0f;
  p = p * z2 + 1.0f / 7.0f;
  p = p * z2 + 1.0f / 5.0f;
  p = p * z2 + 1.0f / 3.0f;
  return 2.0f * z * (p * z2 + 1.0f);
}

/* Raw pixels (n, 2) of points (n, 3) in the camera's own frame. */
void project(const Camera *c, const double *points_mm, int64_t n, double *pixels);

#endif
