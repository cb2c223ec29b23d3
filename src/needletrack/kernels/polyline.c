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

/* The terms (3, d), constant first, of the parabolas that are nearest to values (n, d) at places (n,). Returns 1 where
   the places hold no parabola. */
EXPORT int parabola(const double *at, const double *values, int64_t n, int64_t d, double *terms) {
  enum { TERMS = 3 };
  double normal[TERMS][TERMS] = {{0}}, whole[TERMS];
  memset(terms, 0, (size_t)(TERMS * d) * sizeof *terms);
  for (int64_t i = 0; i < n; i++) {
    double power[TERMS] = {1, at[i], at[i] * at[i]};
    for (int a = 0; a < TERMS; a++) {
      for (int b = 0; b < TERMS; b++) normal[a][b] += power[a] * power[b];
      for (int64_t k = 0; k < d; k++) terms[a * d + k] += power[a] * values[i * d + k];
    }
  }
  for (int a = 0; a < TERMS; a++) whole[a] = normal[a][a];
  /* Gauss and Jordan; the matrix is positive definite, so that no pivot need be looked for. */
  for (int a = 0; a < TERMS; a++) {
    double pivot = normal[a][a];
    if (!(pivot > 1e-13 * whole[a])) return 1;
    for (int b = 0; b < TERMS; b++) normal[a][b] /= pivot;
    for (int64_t k = 0; k < d; k++) terms[a * d + k] /= pivot;
    for (int other = 0; other < TERMS; other++) {
      double share = normal[other][a];
      if (other == a) continue;
      for (int b = 0; b < TERMS; b++) normal[other][b] -= share * normal[a][b];
      for (int64_t k = 0; k < d; k++) terms[other * d + k] -= share * terms[a * d + k];
    }
  }
  return 0;
}
