/* How far a streak of light stands out from what is beside it. */
#include "kernels.h"

/* Correlation (n, count) of sections (n, count) with a line (length,) of odd length, ends repeated. */
EXPORT void contrast(const double *values, int64_t n, int64_t count, const double *line, int64_t length, double *out) {
  int64_t half = length / 2;
  double padded[256];
  for (int64_t i = 0; i < n; i++) {
    const double *row = values + i * count;
    for (int64_t k = 0; k < count + 2 * half; k++) {
      int64_t at = k - half;
      padded[k] = row[at < 0 ? 0 : at >= count ? count - 1 : at];
    }
    double *mine = out + i * count;
    for (int64_t k = 0; k < count; k++) mine[k] = 0;
    for (int64_t j = 0; j < length; j++)
      for (int64_t k = 0; k < count; k++) mine[k] += line[j] * padded[k + j];
  }
}

/* The streak in sections (n, count): its offset and sigma (n,), infinite where it is not seen; how many sections show it.

   low, step: of the places across. half_widths, axis (n,): of the needle. rules = (share of the half width within which
   it lies, most and least contrast, price of turning aside per place, least sigma). work: room for 3 n count + n. */
EXPORT int64_t find_streak(const double *values, int64_t n, int64_t count, const double *line, int64_t length,
                           double low, double step, const double *half_widths, const double *axis, const double *rules,
                           double *offset, double *sigma, double *work) {
  double *strength = work, *worth = strength + n * count;
  int64_t *path = (int64_t *)(worth + n * count), first = count, last = 0, seen = 0;
  contrast(values, n, count, line, length, strength);
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = 0; k < count; k++)
      if (fabs(low + step * (double)k - axis[i]) < rules[0] * half_widths[i]) {
        first = k < first ? k : first, last = k + 1 > last ? k + 1 : last;
      }
  for (int64_t i = 0; i < n; i++) offset[i] = 0, sigma[i] = INFINITY;
  if (last <= first) return 0;
  int64_t wide = last - first;
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = first; k < last; k++) {
      double here = strength[i * count + k];
      int within = fabs(low + step * (double)k - axis[i]) < rules[0] * half_widths[i];
      worth[i * wide + k - first] = within ? (here < 0 ? 0 : here > rules[1] ? rules[1] : here) : -rules[1];
    }
  best_path(worth, n, wide, rules[3], path);
  for (int64_t i = 0; i < n; i++) {
    const double *row = strength + i * count;
    int64_t at = path[i] + first;
    at = at < 1 ? 1 : at > count - 2 ? count - 2 : at;
    for (int climb = 0; climb < 2; climb++) {
      int64_t best = at - 1;
      if (row[at] > row[best]) best = at;
      if (row[at + 1] > row[best]) best = at + 1;
      at = best < 1 ? 1 : best > count - 2 ? count - 2 : best;
    }
    double before = row[at - 1], here = row[at], after = row[at + 1], bend = 2 * here - before - after;
    int within = fabs(low + step * (double)at - axis[i]) < rules[0] * half_widths[i];
    offset[i] = low + step * (double)at;
    if (!(here >= before && here >= after && bend > 0 && within && here > rules[2])) continue;
    seen++;
    offset[i] += 0.5 * step * (after - before) / bend;
    /* The peak of a parabola through noisy samples. */
    double peak = step / 1.4142135623730951 / bend;
    sigma[i] = sqrt(rules[4] * rules[4] + peak * peak);
  }
  return seen;
}
