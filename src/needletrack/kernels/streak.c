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
