/* What an image shows beside a curve, and of a line along it: see `tracking/beside.py`. */
#include "curve.h"

/* Grey levels (n, count) across a curve whose pixels are px (n, 2), by bilinear interpolation; beyond the image: as at its
   border. */
static void strip_across(const Eye *eye, const double *px, int64_t n, double first, double step, int64_t count,
                         float *strip) {
  double right = (double)eye->columns - 1, bottom = (double)eye->rows - 1;
  for (int64_t i = 0; i < n; i++) {
    const double *a = px + 2 * (i > 0 ? i - 1 : 0), *b = px + 2 * (i + 1 < n ? i + 1 : n - 1);
    double dx = b[0] - a[0], dy = b[1] - a[1], length = sqrt(dx * dx + dy * dy);
    length = length > 1e-300 ? length : 1e-300;
    for (int64_t k = 0; k < count; k++) {
      double off = first + step * (double)k, x = px[2 * i] - off * dy / length, y = px[2 * i + 1] + off * dx / length;
      x = x > 0 ? x < right ? x : right : 0, y = y > 0 ? y < bottom ? y : bottom : 0;
      int64_t u = (int64_t)x, v = (int64_t)y, next = u + 1 < eye->columns, below = v + 1 < eye->rows ? eye->stride : 0;
      float s = (float)(x - (double)u), t = (float)(y - (double)v);
      const uint8_t *at = eye->image + v * eye->stride + u;
      strip[i * count + k] = (1 - t) * ((1 - s) * at[0] + s * at[next]) + t * ((1 - s) * at[below] + s * at[below + next]);
    }
  }
}

/* Offset at which a row, followed from `top` on by `way`, has fallen half way to its base there. */
static double half_height(const float *row, float sign, int64_t count, double first, double step, int64_t top, int way,
                          float base) {
  double level = (double)(sign * row[top] + base) / 2;
  int64_t out = top + way;
  while (out >= 0 && out < count && !(sign * row[out] < level)) out += way;
  /* What does not fall so far is as wide as the strip. */
  if (out < 0 || out >= count) out = way > 0 ? 1 : count - 2;
  double before = sign * row[out - way], fall = before - sign * row[out];
  double share = fall > 0 ? (before - level) / fall : 0.5;
  share = share < 0 ? 0 : share > 1 ? 1 : share;
  return way * (first + step * ((double)(out - way) + way * share));
}

/* The line that stands out most across each row of a strip (n, count): see `profile.find_line`.

   reach: columns within which its sides are looked for. */
EXPORT void find_lines(const float *strip, int64_t n, int64_t count, double first, double step, int64_t reach,
                       double search_px, double least_gray, uint8_t *found, double *middle_px, double *width_px,
                       double *height_gray) {
  for (int64_t i = 0; i < n; i++) {
    const float *row = strip + i * count;
    float most = -INFINITY, its_sign = 1, its_low = 0, its_high = 0;
    int64_t top = 0;
    for (int dark = 0; dark < 2; dark++) {
      float sign = dark ? -1 : 1;
      for (int64_t j = 0; j < count; j++) {
        if (!(fabs(first + step * (double)j) <= search_px + 1.0)) continue;
        float low = INFINITY, high = INFINITY;
        for (int64_t k = j - reach; k <= j; k++) {
          float value = sign * row[k < 0 ? 0 : k];
          low = value < low ? value : low;
        }
        for (int64_t k = j; k <= j + reach; k++) {
          float value = sign * row[k >= count ? count - 1 : k];
          high = value < high ? value : high;
        }
        float height = sign * row[j] - (low > high ? low : high);
        if (height > most) most = height, top = j, its_sign = sign, its_low = low, its_high = high;
      }
    }
    double below = half_height(row, its_sign, count, first, step, top, -1, its_low);
    double above = half_height(row, its_sign, count, first, step, top, 1, its_high);
    height_gray[i] = most, middle_px[i] = (above - below) / 2, width_px[i] = above + below;
    found[i] = most > least_gray && width_px[i] > 0.5 && fabs(middle_px[i]) <= search_px;
  }
}

typedef struct {
  const Eye *eye;
  const double *local;
  int64_t n;
  double first, step, sigma;
  int64_t count;
  float *strip;
} Call;

static int once(void *what) {
  Call *c = what;
  int64_t n = c->n, count = c->count;
  double *px = TAKE(double, 2 * n), kernel[63], norm = 0;
  float *raw = TAKE(float, n * count);
  if (!raw) return NO_MEMORY;
  project(c->eye->own, c->local, n, px);
  if (!(c->sigma > 0)) {
    strip_across(c->eye, px, n, c->first, c->step, count, c->strip);
    return FOUND;
  }
  strip_across(c->eye, px, n, c->first, c->step, count, raw);
  int64_t taps = (int64_t)rint(8 * c->sigma + 1) / 2;
  taps = taps > 31 ? 31 : taps;
  for (int64_t k = -taps; k <= taps; k++)
    norm += kernel[k + taps] = exp(-0.5 * (double)(k * k) / (c->sigma * c->sigma));
  memset(c->strip, 0, (size_t)(n * count) * sizeof *raw);
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = -taps; k <= taps; k++) {
      const float *row = raw + count * (i + k < 0 ? 0 : i + k >= n ? n - 1 : i + k);
      float weight = (float)(kernel[k + taps] / norm);
      for (int64_t j = 0; j < count; j++) c->strip[i * count + j] += weight * row[j];
    }
  return FOUND;
}

/* Grey levels (n, count) across a curve (n, 3) in the camera's frame, at offsets first, first + step .. px, smoothed along
   it by a Gaussian of sigma rows, cut off at four of them; 0: not smoothed. */
EXPORT int strip_beside(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *camera,
                        const double *local, int64_t n, double first, double step, int64_t count, double sigma,
                        float *strip) {
  Eye eye = {image, rows, columns, stride, camera, 0};
  Call call = {&eye, local, n, first, step, sigma, count, strip};
  return with_memory(once, &call);
}
