/* Ends of a needle tried in a straightened picture: see `tracking/tip.py`. */
#include <stdlib.h>

#include "kernels.h"

#define PLANES 7
#define MOST 32

/* Least of the mean squared differences of two profiles (n,), the other shifted by up to `most` rows, with its price. */
EXPORT int64_t best_lag(const double *one, const double *other, int64_t n, int64_t most, double price) {
  int64_t best = 0;
  double least = INFINITY;
  for (int64_t lag = -most; lag <= most; lag++) {
    int64_t ahead = lag > 0 ? lag : 0, behind = lag < 0 ? -lag : 0, count = n - ahead - behind;
    double sum = 0;
    for (int64_t i = 0; i < count; i++) {
      double off = one[behind + i] - other[ahead + i];
      sum += off * off;
    }
    double cost = sum / (double)count + price * (double)(lag * lag);
    if (cost < least) least = cost, best = lag;
  }
  return best;
}

static double between(const double *v, int64_t n, double at) {
  if (at <= 0) return v[0];
  if (at >= (double)(n - 1)) return v[n - 1];
  int64_t i = (int64_t)at;
  return v[i] + (at - (double)i) * (v[i + 1] - v[i]);
}

/* The picture (n, count) between columns left and right replaced by the profiles there, shifted along from one to the
   other by `lag` rows. share (count,): how far each column lies on the way. */
EXPORT void filled(double *picture, int64_t n, int64_t count, int64_t left, int64_t right, int64_t lag,
                   const double *share, const double *one, const double *other) {
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = left + 1; k < right; k++) {
      double t = share[k];
      picture[i * count + k] = between(one, n, (double)i - (double)lag * t) * (1 - t) +
                               between(other, n, (double)i + (double)lag * (1 - t)) * t;
    }
}

static double dot(const double *a, const double *b, int64_t n) {
  double sum = 0;
  for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* Adds what one row of the picture that shows `inside` (parts, width) says: by planes and grey, and by itself. */
static void add_row(const double *inside, int64_t step, int64_t parts, const uint8_t *is_there, const double *weighted,
                    int64_t plane_step, const double *weight, int64_t width, double *mixed, double *own) {
  double part[MOST];
  for (int64_t p = 0; p < parts; p++) {
    if (!is_there[p]) continue;
    const double *mine = inside + p * step;
    for (int q = 0; q <= PLANES; q++) mixed[p * (PLANES + 1) + q] += dot(mine, weighted + q * plane_step, width);
    for (int64_t k = 0; k < width; k++) part[k] = mine[k] * weight[k];
    for (int64_t o = 0; o <= p; o++)
      if (is_there[o]) own[p * parts + o] += dot(part, inside + o * step, width);
  }
}

/* For apexes at_mm (apexes,): squared greys left over, and the log determinant of what the parts could show.

   pictures (parts, s, width): of each part of the inside at distances before_mm + picture_mm * (0 ... s - 1) before the
   apex; before and beyond as the outermost. weight (n, width); weighted (8, n, width): planes and grey, weighted;
   fixed (8, 8): their products; prior (7 + parts,)^2; arc_mm (n,) of the rows, ascending. work: room for
   (n + 1) * parts * (8 + parts). Returns 1 where it fails. */
EXPORT int misfits(const double *at_mm, int64_t apexes, const double *arc_mm, int64_t n, int64_t width,
                   const double *pictures, int64_t parts, int64_t s, double before_mm, double picture_mm,
                   const double *weight, const double *weighted, const double *fixed, const double *prior, double *work,
                   double *out) {
  int64_t each = parts * (PLANES + 1 + parts), size = PLANES + parts, plane = n * width;
  uint8_t *there = calloc((size_t)(parts * s), 1);
  if (!there) return 1;
  for (int64_t row = 0; row < s; row++)
    for (int64_t p = 0; p < parts; p++)
      for (int64_t k = 0; k < width; k++)
        if (fabs(pictures[(p * s + row) * width + k]) > 1e-9) there[row * parts + p] = 1;
  /* Far from the apex all rows are alike: sums over the first r rows, all of them of the shaft. */
  memset(work, 0, (size_t)each * sizeof *work);
  for (int64_t r = 0; r < n; r++) {
    double *sums = work + (r + 1) * each;
    memcpy(sums, work + r * each, (size_t)each * sizeof *work);
    add_row(pictures + (s - 1) * width, s * width, parts, there + (s - 1) * parts, weighted + r * width, plane,
            weight + r * width, width, sums, sums + parts * (PLANES + 1));
  }
  int failed = 0;
  for (int64_t a = 0; a < apexes && !failed; a++) {
    double sums[MOST * (PLANES + 1 + MOST)], normal[(PLANES + MOST) * (PLANES + MOST)], target[PLANES + MOST];
    int64_t r = 0;
    while (r < n && (int64_t)rint((at_mm[a] - arc_mm[r] - before_mm) / picture_mm) >= s - 1) r++;
    memcpy(sums, work + r * each, (size_t)each * sizeof *sums);
    for (; r < n; r++) {
      int64_t row = (int64_t)rint((at_mm[a] - arc_mm[r] - before_mm) / picture_mm);
      row = row < 0 ? 0 : row;
      add_row(pictures + row * width, s * width, parts, there + row * parts, weighted + r * width, plane,
              weight + r * width, width, sums, sums + parts * (PLANES + 1));
    }
    const double *own = sums + parts * (PLANES + 1);
    for (int64_t i = 0; i < size; i++) {
      for (int64_t j = 0; j <= i; j++) {
        double value = i < PLANES ? fixed[i * (PLANES + 1) + j]
                       : j < PLANES ? sums[(i - PLANES) * (PLANES + 1) + j] : own[(i - PLANES) * parts + j - PLANES];
        normal[i * size + j] = value + prior[i * size + j];
      }
      target[i] = i < PLANES ? fixed[i * (PLANES + 1) + PLANES] : sums[(i - PLANES) * (PLANES + 1) + PLANES];
    }
    double log_determinant = 0;
    for (int64_t i = 0; i < size && !failed; i++) {
      double *mine = normal + i * size;
      for (int64_t j = 0; j < i; j++) mine[j] = (mine[j] - dot(mine, normal + j * size, j)) / normal[j * size + j];
      double rest = mine[i] - dot(mine, mine, i);
      if (!(rest > 0)) failed = 1;
      mine[i] = sqrt(rest);
      log_determinant += 2 * log(mine[i]);
      target[i] = (target[i] - dot(mine, target, i)) / mine[i];
    }
    out[2 * a] = fixed[PLANES * (PLANES + 1) + PLANES] - dot(target, target, size);
    out[2 * a + 1] = log_determinant;
  }
  free(there);
  return failed;
}
