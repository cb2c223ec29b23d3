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

/* e^x of single precision for x <= 0, to 1e-6 of itself; below -87 it is nearly 0. */
static inline float exp_negative(float x) {
  x = x < -87.0f ? -87.0f : x;
  float n = x * 1.44269504f + 12582912.0f; /* rounds to a whole number in its lowest bits */
  int32_t bits;
  memcpy(&bits, &n, sizeof bits);
  n -= 12582912.0f;
  float r = x - n * 0.693359375f + n * 2.12194440e-4f;
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * r * r + r + 1.0f;
  int32_t power = (bits - 0x4b400000 + 127) << 23;
  float two;
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
