/* How a needle moves between two pairs: see `tracking/motion.py`. */
#include "curve.h"

enum { TERMS = 3, PLACES = 32 };

/* How far aside (n, 3) each point of a curve (n, 3) has come since another one (m, 3), smoothly along it: a parabola
   over its length. Returns 1 where there is no memory. */
static int moved_aside(const double *before, int64_t m, const double *now, int64_t n, double *out) {
  double *arc_before = TAKE(double, m), *arc = TAKE(double, n), at[PLACES], share[PLACES], was[PLACES][3],
         is[PLACES][3], terms[TERMS][3];
  if (!arc) return NO_MEMORY;
  lengths(before, m, arc_before), lengths(now, n, arc);
  double common = arc_before[m - 1] < arc[n - 1] ? arc_before[m - 1] : arc[n - 1];
  for (int i = 0; i < PLACES; i++) share[i] = (double)i / (PLACES - 1), at[i] = common * share[i];
  interpolated(before, arc_before, m, at, PLACES, was[0]);
  interpolated(now, arc, n, at, PLACES, is[0]);
  for (int i = 0; i < PLACES; i++) {
    const double *a = is[i > 0 ? i - 1 : 0], *b = is[i + 1 < PLACES ? i + 1 : i];
    double along[3], square = 0, slid = 0;
    for (int d = 0; d < 3; d++) along[d] = b[d] - a[d], square += along[d] * along[d];
    for (int d = 0; d < 3; d++) slid += (is[i][d] - was[i][d]) * along[d];
    slid /= square > 1e-300 ? square : 1e-300;
    for (int d = 0; d < 3; d++) was[i][d] = is[i][d] - was[i][d] - slid * along[d];
  }
  if (parabola(share, was[0], PLACES, 3, terms[0])) return NOT_HELD;
  for (int64_t i = 0; i < n; i++) {
    double x = common > 0 ? arc[i] / common : 0;
    for (int d = 0; d < 3; d++) out[3 * i + d] = terms[0][d] + x * (terms[1][d] + x * terms[2][d]);
  }
  return FOUND;
}

typedef struct {
  const double *before, *now;
  int64_t m, n;
  double *out;
} Call;

static int once(void *what) {
  Call *call = what;
  return moved_aside(call->before, call->m, call->now, call->n, call->out);
}

/* See `motion.moved_aside_mm`. */
EXPORT int motion_aside(const double *before, int64_t m, const double *now, int64_t n, double *out) {
  Call call = {before, now, m, n, out};
  return with_memory(once, &call);
}
