/* A smooth curve through triangulated points, of which some are wrong. */
#include "kernels.h"

/* Control points (count, 3) of the cubic spline through points (n, 3) of confidence (n,) that weighs them by it and by
   how far off they are (Cauchy), in `rounds` rounds. first, mixing (n,), (n, 4): its basis there; stiffness (count, 4):
   what its bends cost, by the diagonal and the three beside it. work (4 * count + 2 * n). */
EXPORT void rough_curve(const double *points, const double *confidence, int64_t n, int64_t count, const int64_t *first,
                        const double *mixing, const double *stiffness, int64_t rounds, double least_scale, double *work,
                        double *control) {
  double *band = work, *weight = band + 4 * count;
  float *error = (float *)(weight + n);
  for (int64_t i = 0; i < n; i++) weight[i] = confidence[i] * confidence[i];
  for (int64_t round = 0; round < rounds; round++) {
    memcpy(band, stiffness, (size_t)(4 * count) * sizeof(double));
    memset(control, 0, (size_t)(3 * count) * sizeof(double));
    for (int64_t i = 0; i < n; i++) {
      const double *m = mixing + 4 * i;
      for (int a = 0; a < 4; a++) {
        double w = weight[i] * m[a];
        for (int b = a; b < 4; b++) band[4 * (first[i] + a) + b - a] += w * m[b];
        for (int k = 0; k < 3; k++) control[3 * (first[i] + a) + k] += w * points[3 * i + k];
      }
    }
    /* Cholesky's factors, row by row: band[4 i + d] becomes U[i][i + d]. */
    for (int64_t i = 0; i < count; i++) {
      for (int d = 0; d < 4 && i + d < count; d++) {
        double sum = band[4 * i + d];
        for (int e = 1; d + e < 4 && e <= i; e++) sum -= band[4 * (i - e) + e] * band[4 * (i - e) + e + d];
        band[4 * i + d] = d ? sum / band[4 * i] : sqrt(sum);
      }
      for (int k = 0; k < 3; k++) {
        double sum = control[3 * i + k];
        for (int e = 1; e < 4 && e <= i; e++) sum -= band[4 * (i - e) + e] * control[3 * (i - e) + k];
        control[3 * i + k] = sum / band[4 * i];
      }
    }
    for (int64_t i = count - 1; i >= 0; i--)
      for (int k = 0; k < 3; k++) {
        double sum = control[3 * i + k];
        for (int e = 1; e < 4 && i + e < count; e++) sum -= band[4 * i + e] * control[3 * (i + e) + k];
        control[3 * i + k] = sum / band[4 * i];
      }
    if (round + 1 == rounds) break;
    for (int64_t i = 0; i < n; i++) {
      double off = 0;
      for (int k = 0; k < 3; k++) {
        double at = -points[3 * i + k];
        for (int a = 0; a < 4; a++) at += mixing[4 * i + a] * control[3 * (first[i] + a) + k];
        off += at * at;
      }
      weight[i] = sqrt(off);
      error[i] = (float)weight[i];
    }
    double median = (double)selected(error, n, n / 2);
    if (n % 2 == 0) median = (median + (double)selected(error, n, n / 2 - 1)) / 2;
    double scale = fmax(least_scale, 1.5 * median);
    for (int64_t i = 0; i < n; i++)
      weight[i] = confidence[i] * confidence[i] / (1 + weight[i] * weight[i] / (scale * scale));
  }
}
