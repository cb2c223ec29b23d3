/* What is told of a needle whose curve is fitted: see `tracking/shape.py`. */
#include "kernels.h"

static double dot(const double *a, const double *b, int64_t n) {
  double sum = 0;
  for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* What is told of a fitted curve beside its points: see `shape.judged`.

   u (n,): parameters of the points (n, 3); covariance (n, 3, 3) of each. sigma, bend (n,): out, the larger standard
   deviation across the curve, mm, and its curvature, 1/mm. ends (2, 3): out, unit directions at both ends. Returns the share of its points whose picture in the right
   view runs within a sine of the epipolar lines; fundamental (3, 3) is for pixels without distortion. */
EXPORT double told_of_curve(const double *control, int64_t m, const double *u, const double *points, int64_t n,
                            const double *covariance, const Camera *left, const Camera *right,
                            const double *fundamental, double sine, double *sigma, double *bend, double *ends) {
  int64_t first[n], along_lines = 0;
  double mixing[2][4 * n], pixels[2][2 * n];
  for (int order = 1; order <= 2; order++) basis(u, n, m, order, first, mixing[order - 1]);
  for (int v = 0; v < 2; v++) {
    const Camera *c = v ? right : left;
    const double *r = c->rotation, *t = c->translation_mm;
    for (int64_t i = 0; i < n; i++) {
      const double *p = points + 3 * i;
      double z = dot(r + 6, p, 3) + t[2], x = (dot(r, p, 3) + t[0]) / z, y = (dot(r + 3, p, 3) + t[1]) / z;
      pixels[v][2 * i] = c->fx * x + c->skew * y + c->cx, pixels[v][2 * i + 1] = c->fy * y + c->cy;
    }
  }
  for (int64_t i = 0; i < n; i++) {
    double d[2][3] = {{0}};
    for (int order = 0; order < 2; order++)
      for (int a = 0; a < 4; a++)
        for (int k = 0; k < 3; k++) d[order][k] += mixing[order][4 * i + a] * control[3 * (first[i] + a) + k];
    double cross[3] = {d[0][1] * d[1][2] - d[0][2] * d[1][1], d[0][2] * d[1][0] - d[0][0] * d[1][2],
                       d[0][0] * d[1][1] - d[0][1] * d[1][0]};
    double speed = sqrt(dot(d[0], d[0], 3));
    speed = speed > 1e-300 ? speed : 1e-300;
    bend[i] = sqrt(dot(cross, cross, 3)) / (speed * speed * speed);
    if (i == 0 || i == n - 1)
      for (int k = 0; k < 3; k++) ends[3 * (i > 0) + k] = d[0][k] / speed;
    /* Two directions across: the axis that the tangent is least along, made perpendicular to it, and theirs. */
    double along[3] = {d[0][0] / speed, d[0][1] / speed, d[0][2] / speed}, one[3], other[3];
    int least = fabs(along[0]) < fabs(along[1]) ? 0 : 1;
    least = fabs(along[2]) < fabs(along[least]) ? 2 : least;
    for (int k = 0; k < 3; k++) one[k] = (k == least) - along[least] * along[k];
    double length = sqrt(dot(one, one, 3));
    for (int k = 0; k < 3; k++) one[k] /= length;
    for (int k = 0; k < 3; k++)
      other[k] = along[(k + 1) % 3] * one[(k + 2) % 3] - along[(k + 2) % 3] * one[(k + 1) % 3];
    double a = 0, b = 0, c = 0;
    for (int p = 0; p < 3; p++)
      for (int q = 0; q < 3; q++) {
        double value = covariance[9 * i + 3 * p + q];
        a += one[p] * value * one[q], b += one[p] * value * other[q], c += other[p] * value * other[q];
      }
    double variance = (a + c) / 2 + sqrt((a - c) * (a - c) / 4 + b * b);
    sigma[i] = sqrt(variance > 1e-12 ? variance : 1e-12);
    const double *l = pixels[0] + 2 * i, *before = pixels[1] + 2 * (i > 0 ? i - 1 : 0),
                 *after = pixels[1] + 2 * (i + 1 < n ? i + 1 : n - 1);
    double line[2], run[2] = {after[0] - before[0], after[1] - before[1]};
    for (int k = 0; k < 2; k++)
      line[k] = fundamental[3 * k] * l[0] + fundamental[3 * k + 1] * l[1] + fundamental[3 * k + 2];
    /* The line's normal by the tangent: the sine of the angle between them. */
    double off = fabs(line[0] * run[0] + line[1] * run[1]) /
                 sqrt((line[0] * line[0] + line[1] * line[1]) * (run[0] * run[0] + run[1] * run[1]) + 1e-300);
    along_lines += off < sine;
  }
  return (double)along_lines / (double)n;
}

/* Adds the unit direction at a tip, where `at` is 0, of the polynomial nearest to the stretch of points (n, 3) that ends
   skip_mm before it and is so long; 1 where there are too few of them. at (n,): arc lengths, 0 at the tip. */
static int lead(const double *points, const double *at, int64_t n, double skip_mm, double length_mm, int degree,
                double *direction) {
  int64_t first = 0, last = n;
  while (first < n && at[first] < -skip_mm - length_mm) first++;
  while (last > first && at[last - 1] > -skip_mm) last--;
  if (last - first < 2 * degree + 1) return 1;
  /* About the middle of the stretch, and in halves of it: powers of millimetres would cost half the digits. */
  double middle = (at[first] + at[last - 1]) / 2, half = (at[last - 1] - at[first]) / 2, place[last - first];
  double terms[3 * (MOST_DEGREE + 1)], slope[3] = {0}, power = 1, tip = -middle / half;
  for (int64_t i = first; i < last; i++) place[i - first] = (at[i] - middle) / half;
  if (polynomial(place, points + 3 * first, last - first, 3, degree, terms)) return 1;
  for (int a = 1; a <= degree; a++, power *= tip)
    for (int k = 0; k < 3; k++) slope[k] += a * power * terms[3 * a + k];
  double length = sqrt(dot(slope, slope, 3));
  for (int k = 0; k < 3; k++) direction[k] += slope[k] / (length > 1e-300 ? length : 1e-300);
  return 0;
}

/* Unit direction (3,) out of the tip of a curve (n, 3) of curvatures (n,): see `shape.told_of_tip`.

   rules = (stretch over which the bend is told, what is left out before the tip, and for a parabola and a cubic each the
   longest and the least stretch, mm, and the turn over which it follows a needle, radians). */
EXPORT void direction_of_tip(const double *points, int64_t n, const double *bend, const double *rules, double *out) {
  double at[n], sorted[n], direction[3] = {0};
  at[n - 1] = 0;
  for (int64_t i = n - 2; i >= 0; i--) {
    double step[3];
    for (int k = 0; k < 3; k++) step[k] = points[3 * i + 3 + k] - points[3 * i + k];
    at[i] = at[i + 1] - sqrt(dot(step, step, 3));
  }
  int64_t near = 0, count = 0;
  while (at[near] < -rules[0]) near++;
  for (int64_t i = near; i < n; i++, count++) {
    int64_t place = count;
    while (place > 0 && sorted[place - 1] > bend[i]) sorted[place] = sorted[place - 1], place--;
    sorted[place] = bend[i];
  }
  double middle = (sorted[count / 2] + sorted[(count - 1) / 2]) / 2;
  for (int each = 0; each < 2; each++) {
    const double *r = rules + 2 + 3 * each;
    double stretch = r[2] / (middle > 1e-6 ? middle : 1e-6);
    stretch = stretch < r[1] ? r[1] : stretch > r[0] ? r[0] : stretch;
    lead(points, at, n, rules[1], stretch, 2 + each, direction);
  }
  double length = sqrt(dot(direction, direction, 3));
  if (!(length > 0)) {
    for (int k = 0; k < 3; k++) direction[k] = points[3 * (n - 1) + k] - points[3 * (n - 2) + k];
    length = sqrt(dot(direction, direction, 3));
  }
  for (int k = 0; k < 3; k++) out[k] = direction[k] / (length > 1e-300 ? length : 1e-300);
}

/* Covariance (3, 3) of a tip of so much along the needle and `across`, (3, 3), of its point of the curve; `open` (3, 3):
   what the calibration leaves open, or null. Returns the largest standard deviation. */
EXPORT double covariance_of_tip(const double *across, const double *open, const double *along, double along_mm2,
                                double *out) {
  for (int p = 0; p < 3; p++)
    for (int q = 0; q < 3; q++) {
      double both = across[3 * p + q] + across[3 * q + p] + (open ? open[3 * p + q] + open[3 * q + p] : 0);
      out[3 * p + q] = both / 2 + along_mm2 * along[p] * along[q];
    }
  /* The largest eigenvalue of a symmetric matrix of three (Smith 1961, Communications of the ACM 4.4). */
  double mean = (out[0] + out[4] + out[8]) / 3, square = 0, apart[9];
  for (int k = 0; k < 9; k++) apart[k] = out[k] - (k % 4 ? 0 : mean), square += apart[k] * apart[k];
  double scale = sqrt(square / 6);
  if (!(scale > 1e-300)) return sqrt(mean > 0 ? mean : 0);
  for (int k = 0; k < 9; k++) apart[k] /= scale;
  double half = (apart[0] * (apart[4] * apart[8] - apart[5] * apart[7]) - apart[1] * (apart[3] * apart[8] - apart[5] * apart[6]) +
                 apart[2] * (apart[3] * apart[7] - apart[4] * apart[6])) / 2;
  half = half < -1 ? -1 : half > 1 ? 1 : half;
  double largest = mean + 2 * scale * cos(acos(half) / 3);
  return sqrt(largest > 0 ? largest : 0);
}

/* First-order geometric distance, px, of one raw pixel (2,) of each view from the epipolar constraint of pixels without
   distortion (Hartley and Zisserman 2004, 11.9). */
EXPORT double off_epipolar_px(const Camera *left, const Camera *right, const double *fundamental, const double *pixels) {
  double seen[2][3];
  for (int v = 0; v < 2; v++) {
    const Camera *c = v ? right : left;
    double ray[2];
    ray_of(c, pixels + 2 * v, ray);
    seen[v][0] = c->fx * ray[0] + c->skew * ray[1] + c->cx, seen[v][1] = c->fy * ray[1] + c->cy, seen[v][2] = 1;
  }
  double off = 0, square = 0;
  for (int k = 0; k < 3; k++) {
    double in_right = dot(fundamental + 3 * k, seen[0], 3), in_left = 0;
    for (int j = 0; j < 3; j++) in_left += fundamental[3 * j + k] * seen[1][j];
    off += in_right * seen[1][k];
    if (k < 2) square += in_right * in_right + in_left * in_left;
  }
  return fabs(off) / sqrt(square > 1e-300 ? square : 1e-300);
}
