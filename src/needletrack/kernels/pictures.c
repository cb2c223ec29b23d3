/* Pictures of the end of a needle: see `tip.inside_pictures`. */
#include "kernels.h"

/* Pictures (n, 2 parts, columns) of the inside of an end of half widths (n,), each part first on the shaft and then on the
   end, which is what lies before `on_end`; blurred across and, in rows, along by these standard deviations; beyond its
   first and last row all is as in these. work: as large as the pictures. */
EXPORT void end_pictures(const double *width, int64_t n, int64_t on_end, const double *across, int64_t columns,
                         int64_t parts, double blur, double along, double *pictures, double *work) {
  int64_t row = 2 * parts * columns, reach = (int64_t)(4 * along + 0.5);
  memset(work, 0, (size_t)(n * row) * sizeof *work);
  for (int64_t i = 0; i < n; i++)
    for (int64_t part = 0; part < parts; part++) {
      double low = (2 * (double)part / (double)parts - 1) * width[i];
      double high = (2 * (double)(part + 1) / (double)parts - 1) * width[i], over = 1 / blur;
      double *restrict out = work + i * row + (part + (i < on_end ? parts : 0)) * columns;
      for (int64_t c = 0; c < columns; c++)
        out[c] = normal_share((across[c] - low) * over) - normal_share((across[c] - high) * over);
    }
  double norm = 1;
  for (int64_t k = 1; k <= reach; k++) norm += 2 * exp(-0.5 * (double)(k * k) / (along * along));
  for (int64_t i = 0; i < n; i++) {
    double *restrict out = pictures + i * row;
    for (int64_t c = 0; c < row; c++) out[c] = work[i * row + c] / norm;
    for (int64_t k = 1; k <= reach; k++) {
      const double *before = work + (i - k > 0 ? i - k : 0) * row, *after = work + (i + k < n ? i + k : n - 1) * row;
      double weight = exp(-0.5 * (double)(k * k) / (along * along)) / norm;
      for (int64_t c = 0; c < row; c++) out[c] += weight * (before[c] + after[c]);
    }
  }
}
