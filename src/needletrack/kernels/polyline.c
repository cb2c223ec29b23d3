/* Polylines of points of `d` numbers: their lengths, and how far something lies from them. */
#include "kernels.h"

/* Arc lengths (n,) of a polyline (n, d). */
EXPORT void arc_lengths(const double *points, int64_t n, int64_t d, double *arc) {
  if (n > 0) arc[0] = 0;
  for (int64_t i = 1; i < n; i++) {
    double square = 0;
    for (int64_t k = 0; k < d; k++) {
      double step = points[i * d + k] - points[(i - 1) * d + k];
      square += step * step;
    }
    arc[i] = arc[i - 1] + sqrt(square);
  }
}

/* Points (count, d), evenly spaced from arc length `from` to `until`, of a polyline (n, d) of arc lengths (n,); what lies
   before its first point or beyond its last is that point. */
EXPORT void cut_evenly(const double *points, const double *arc, int64_t n, int64_t d, double from, double until,
                       int64_t count, double *out) {
  int64_t k = 0;
  for (int64_t i = 0; i < count; i++) {
    double at = i + 1 == count ? until : from + (until - from) * (double)i / (double)(count > 1 ? count - 1 : 1);
    at = at < 0 ? 0 : at > arc[n - 1] ? arc[n - 1] : at;
    while (k < n - 2 && arc[k + 1] < at) k++;
    double step = n > 1 ? arc[k + 1] - arc[k] : 0, share = step > 0 ? (at - arc[k]) / step : 0;
    for (int64_t j = 0; j < d; j++) {
      double here = points[k * d + j], ahead = n > 1 ? points[(k + 1) * d + j] : here;
      out[i * d + j] = here + share * (ahead - here);
    }
  }
}

/* Distances (count,) of points (count, d) from a polyline (n, d). */
EXPORT void distances_from(const double *points, int64_t count, const double *line, int64_t n, int64_t d, double *out) {
  for (int64_t i = 0; i < count; i++) {
    const double *p = points + i * d;
    double least = INFINITY;
    for (int64_t s = 0; s < n - 1; s++) {
      const double *a = line + s * d;
      double along = 0, square = 0, off = 0;
      for (int64_t k = 0; k < d; k++) along += (p[k] - a[k]) * (a[d + k] - a[k]), square += (a[d + k] - a[k]) * (a[d + k] - a[k]);
      double share = along / (square > 1e-12 ? square : 1e-12);
      share = share < 0 ? 0 : share > 1 ? 1 : share;
      for (int64_t k = 0; k < d; k++) {
        double gap = p[k] - a[k] - share * (a[d + k] - a[k]);
        off += gap * gap;
      }
      least = off < least ? off : least;
    }
    out[i] = sqrt(least);
  }
}

/* The terms (degree + 1, d), constant first, of the polynomials that are nearest to values (n, d) at places (n,), of a
   degree of MOST_DEGREE at most. Returns 1 where the places hold none. */
int polynomial(const double *at, const double *values, int64_t n, int64_t d, int degree, double *terms) {
  double normal[MOST_DEGREE + 1][MOST_DEGREE + 1] = {{0}}, whole[MOST_DEGREE + 1];
  int count = degree + 1;
  memset(terms, 0, (size_t)(count * d) * sizeof *terms);
  for (int64_t i = 0; i < n; i++) {
    double power[MOST_DEGREE + 1] = {1};
    for (int a = 1; a < count; a++) power[a] = power[a - 1] * at[i];
    for (int a = 0; a < count; a++) {
      for (int b = 0; b < count; b++) normal[a][b] += power[a] * power[b];
      for (int64_t k = 0; k < d; k++) terms[a * d + k] += power[a] * values[i * d + k];
    }
  }
  for (int a = 0; a < count; a++) whole[a] = normal[a][a];
  /* Gauss and Jordan; the matrix is positive definite, so that no pivot need be looked for. */
  for (int a = 0; a < count; a++) {
    double pivot = normal[a][a];
    if (!(pivot > 1e-13 * whole[a])) return 1;
    for (int b = 0; b < count; b++) normal[a][b] /= pivot;
    for (int64_t k = 0; k < d; k++) terms[a * d + k] /= pivot;
    for (int other = 0; other < count; other++) {
      double share = normal[other][a];
      if (other == a) continue;
      for (int b = 0; b < count; b++) normal[other][b] -= share * normal[a][b];
      for (int64_t k = 0; k < d; k++) terms[other * d + k] -= share * terms[a * d + k];
    }
  }
  return 0;
}

/* The terms (3, d) of the parabolas that are nearest: see `polynomial`. */
EXPORT int parabola(const double *at, const double *values, int64_t n, int64_t d, double *terms) {
  return polynomial(at, values, n, d, 2, terms);
}
