/* The image straightened along a projected curve, and its cross sections. */
#include "kernels.h"

static inline int64_t within(int64_t i, int64_t n) { return i < 0 ? 0 : i >= n ? n - 1 : i; }

typedef float Four __attribute__((vector_size(16)));
typedef uint8_t FourBytes __attribute__((vector_size(4)));

/* Cubic convolution (Keys 1981) with a = -0.75, as OpenCV's: weights of the four pixels about a place. */
static inline Four weights(float t) {
  const float a = -0.75f;
  const Four cubed = {a, a + 2, -(a + 2), -a}, squared = {-2 * a, -(a + 3), 2 * a + 3, a}, once = {a, 0, -a, 0},
             constant = {0, 1, 0, 0};
  return ((cubed * t + squared) * t + once) * t + constant;
}

static inline float sampled(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, float x, float y) {
  float fx = floorf(x), fy = floorf(y);
  int64_t ix = (int64_t)fx - 1, iy = (int64_t)fy - 1;
  Four across = weights(x - fx), down = weights(y - fy), sum = {0, 0, 0, 0};
  if (ix >= 0 && iy >= 0 && ix + 4 <= columns && iy + 4 <= rows) {
    const uint8_t *at = image + iy * stride + ix;
    for (int r = 0; r < 4; r++, at += stride) {
      FourBytes four;
      memcpy(&four, at, sizeof four);
      sum += down[r] * __builtin_convertvector(four, Four);
    }
  } else {
    for (int r = 0; r < 4; r++) {
      const uint8_t *row = image + within(iy + r, rows) * stride;
      for (int k = 0; k < 4; k++) sum[k] += down[r] * (float)row[within(ix + k, columns)];
    }
  }
  sum *= across;
  float gray = (sum[0] + sum[1]) + (sum[2] + sum[3]);
  return gray < 0 ? 0 : gray > 255 ? 255 : gray;
}

#ifdef __AVX2__
#include <immintrin.h>

/* The weights of eight places in one of their four pixels. */
static inline __m256 eight_weights(__m256 t, float cubed, float squared, float once, float constant) {
  __m256 w = _mm256_fmadd_ps(_mm256_set1_ps(cubed), t, _mm256_set1_ps(squared));
  w = _mm256_fmadd_ps(w, t, _mm256_set1_ps(once));
  return _mm256_fmadd_ps(w, t, _mm256_set1_ps(constant));
}

/* The k-th byte of each of eight numbers. A shuffle does not wait for the units that multiply, as shifts would. */
static inline __m256 bytes(__m256i four, int k) {
  __m256i order = _mm256_add_epi32(_mm256_setr_epi32(0, 4, 8, 12, 0, 4, 8, 12), _mm256_set1_epi32(k));
  return _mm256_cvtepi32_ps(_mm256_shuffle_epi8(four, _mm256_or_si256(order, _mm256_set1_epi32((int)0x80808000))));
}

/* Four places from `from` on, `step` apart per offset. */
static inline __m128 four_places(double from, double step, const double *offsets) {
  return _mm256_cvtpd_ps(
      _mm256_fmadd_pd(_mm256_loadu_pd(offsets), _mm256_set1_pd(step), _mm256_set1_pd(from)));
}

/* Eight places at once, all of whose pixels are in the image: four bytes side by side are gathered as one number. */
static inline void eight_sampled(const uint8_t *image, int64_t stride, __m256 x, __m256 y, float *out) {
  const float a = -0.75f;
  __m256 fx = _mm256_floor_ps(x), fy = _mm256_floor_ps(y), tx = _mm256_sub_ps(x, fx), ty = _mm256_sub_ps(y, fy);
  __m256i one = _mm256_set1_epi32(1), at = _mm256_add_epi32(
      _mm256_mullo_epi32(_mm256_sub_epi32(_mm256_cvtps_epi32(fy), one), _mm256_set1_epi32((int32_t)stride)),
      _mm256_sub_epi32(_mm256_cvtps_epi32(fx), one));
  __m256 across[4] = {eight_weights(tx, a, -2 * a, a, 0), eight_weights(tx, a + 2, -(a + 3), 0, 1),
                      eight_weights(tx, -(a + 2), 2 * a + 3, -a, 0), eight_weights(tx, -a, a, 0, 0)},
         down[4] = {eight_weights(ty, a, -2 * a, a, 0), eight_weights(ty, a + 2, -(a + 3), 0, 1),
                    eight_weights(ty, -(a + 2), 2 * a + 3, -a, 0), eight_weights(ty, -a, a, 0, 0)};
  __m256 sum = _mm256_setzero_ps();
  for (int r = 0; r < 4; r++) {
    __m256i four = _mm256_i32gather_epi32((const int *)(image + r * stride), at, 1);
    __m256 row = _mm256_mul_ps(across[0], bytes(four, 0));
    for (int k = 1; k < 4; k++) row = _mm256_fmadd_ps(across[k], bytes(four, k), row);
    sum = _mm256_fmadd_ps(down[r], row, sum);
  }
  sum = _mm256_min_ps(_mm256_max_ps(sum, _mm256_setzero_ps()), _mm256_set1_ps(255));
  _mm256_storeu_ps(out, sum);
}
#endif

/* One row across: count places from (x, y) along (dx, dy). */
static void row_across(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, double x, double y,
                       double dx, double dy, const double *offsets, int64_t count, float *gray) {
  int64_t k = 0;
#ifdef __AVX2__
  double first = offsets[0], last = offsets[count - 1];
  double left = fmin(x + first * dx, x + last * dx), right = fmax(x + first * dx, x + last * dx),
         top = fmin(y + first * dy, y + last * dy), bottom = fmax(y + first * dy, y + last * dy);
  if (left >= 1.01 && top >= 1.01 && right <= (double)columns - 3.01 && bottom <= (double)rows - 3.01 &&
      rows * stride < INT32_MAX && count >= 8)
    for (; k < count; k += 8) {
      /* The last eight may overlap those before. */
      int64_t at = k + 8 <= count ? k : count - 8;
      __m256 px = _mm256_set_m128(four_places(x, dx, offsets + at + 4), four_places(x, dx, offsets + at)),
             py = _mm256_set_m128(four_places(y, dy, offsets + at + 4), four_places(y, dy, offsets + at));
      eight_sampled(image, stride, px, py, gray + at);
    }
#endif
  for (; k < count; k++)
    gray[k] = sampled(image, rows, columns, stride, (float)(x + offsets[k] * dx), (float)(y + offsets[k] * dy));
}

/* Unit tangents (n, 2) of a polyline (n, 2) by central differences, turned by a quarter: its normals. */
static void normals(const double *px, int64_t n, double *normal) {
  for (int64_t i = 0; i < n; i++) {
    const double *a = px + 2 * (i > 0 ? i - 1 : 0), *b = px + 2 * (i + 1 < n ? i + 1 : n - 1);
    double dx = b[0] - a[0], dy = b[1] - a[1], length = sqrt(dx * dx + dy * dy);
    length = length > 1e-300 ? length : 1e-300;
    normal[2 * i] = -dy / length, normal[2 * i + 1] = dx / length;
  }
}

/* Grey levels (n, count) across a curve (n, 3) in the camera's frame, at offsets (count,) of unit_mm; its pixels (n, 2). */
EXPORT void straighten(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *c,
                       const double *local_mm, int64_t n, const double *offsets, int64_t count, double unit_mm,
                       double *px, double *normal, float *gray) {
  double focal = (c->fx + c->fy) / 2;
  for (int64_t i = 0; i < n; i++) {
    const double *p = local_mm + 3 * i;
    distorted(c, p[0] / p[2], p[1] / p[2], px + 2 * i, 0);
  }
  normals(px, n, normal);
  for (int64_t i = 0; i < n; i++) {
    double scale = focal / local_mm[3 * i + 2] * unit_mm;
    double x = px[2 * i], y = px[2 * i + 1], dx = scale * normal[2 * i], dy = scale * normal[2 * i + 1];
    /* What lies behind the camera, or nowhere, is of no grey. */
    if (!(fabs(x) < 1e6 && fabs(y) < 1e6 && fabs(dx) < 1e4 && fabs(dy) < 1e4)) {
      for (int64_t k = 0; k < count; k++) gray[i * count + k] = 0;
      continue;
    }
    row_across(image, rows, columns, stride, x, y, dx, dy, offsets, count, gray + i * count);
  }
}

/* The value that is the k-th of n in order; v is partly sorted. */
float selected(float *v, int64_t n, int64_t k) {
  int64_t low = 0, high = n - 1;
  while (low < high) {
    float pivot = v[(low + high) / 2];
    int64_t i = low, j = high;
    while (i <= j) {
      while (v[i] < pivot) i++;
      while (v[j] > pivot) j--;
      if (i <= j) {
        float t = v[i];
        v[i++] = v[j], v[j--] = t;
      }
    }
    if (k <= j) high = j;
    else if (k >= i) low = i;
    else break;
  }
  return v[k];
}

/* See `profile.noise_gray`: from second differences of every other one of the ten columns at each rim. */
EXPORT double noise(const float *strip, int64_t n, int64_t count, float *work) {
  int64_t total = 0;
  for (int64_t i = 0; i < n; i++) {
    const float *row = strip + i * count;
    for (int side = 0; side < 2; side++) {
      const float *at = side ? row + count - 10 : row;
      for (int k = 0; k < 3; k++) work[total++] = fabsf(at[2 * k] - 2 * at[2 * k + 2] + at[2 * k + 4]);
    }
  }
  int64_t quiet = (int64_t)(0.8 * (double)total);
  quiet = quiet < 1 ? 1 : quiet;
  selected(work, total, quiet - 1);
  double sum = 0;
  for (int64_t i = 0; i < quiet; i++) sum += work[i];
  double sigma = sum / (double)quiet / 0.5586 / sqrt(6.0);
  return sigma > 0.3 ? sigma : 0.3;
}

/* The sections about each point of a curve (n, 3): each the mean of `per` rows about a pixel apart, in units of noise.

   work: room for per * n rows, 7 + 8 * count doubles each. least_gray, per_noise: the unit in which they are measured. */
EXPORT void cut_sections(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *c,
                         const double *local_mm, int64_t n, int64_t per, const double *offsets, int64_t count,
                         double unit_mm, double least_gray, double per_noise, double *work, double *center,
                         double *normal, double *values, double *px_per_unit, uint8_t *inside) {
  int64_t all = n * per;
  double *dense = work, *px = dense + 3 * all, *across = px + 2 * all;
  float *strip = (float *)(across + 2 * all), *spare = strip + all * count;
  for (int64_t i = 0; i < n; i++) {
    const double *a = local_mm + 3 * (i > 0 ? i - 1 : 0), *b = local_mm + 3 * (i + 1 < n ? i + 1 : n - 1);
    double share = (i > 0 && i + 1 < n ? 0.5 : 1.0) / (double)per;
    for (int64_t r = 0; r < per; r++)
      for (int k = 0; k < 3; k++)
        dense[3 * (i * per + r) + k] =
            local_mm[3 * i + k] + ((double)r - (double)(per - 1) / 2) * share * (b[k] - a[k]);
  }
  straighten(image, rows, columns, stride, c, dense, all, offsets, count, unit_mm, px, across, strip);
  double unit = per_noise * noise(strip, all, count, spare);
  unit = unit > least_gray ? unit : least_gray;
  for (int64_t i = 0; i < n; i++) {
    double *section = values + i * count;
    for (int64_t k = 0; k < count; k++) section[k] = 0;
    for (int64_t r = 0; r < per; r++) {
      const float *row = strip + (i * per + r) * count;
      for (int64_t k = 0; k < count; k++) section[k] += row[k];
    }
    for (int64_t k = 0; k < count; k++) section[k] /= (double)per * unit;
  }
  double focal = (c->fx + c->fy) / 2;
  project(c, local_mm, n, center);
  normals(center, n, normal);
  for (int64_t i = 0; i < n; i++) {
    double x = center[2 * i], y = center[2 * i + 1];
    px_per_unit[i] = focal / local_mm[3 * i + 2] * unit_mm;
    inside[i] = x >= 2 && y >= 2 && x <= (double)columns - 3 && y <= (double)rows - 3;
  }
}
