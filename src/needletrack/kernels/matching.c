/* Lines of two views: where epipolar lines cross them, in what order both can be followed, and depth from their ends. */
#include "kernels.h"

/* What the kernels need to know of a rig, in undistorted pixels: all doubles, as `match._rig_of` lays it out.
   right^T fundamental left = 0; rays are (x, y, 1) in each camera's own frame; left_from_right turns them. */
typedef struct {
  double fundamental[9], ray_of_left[9], ray_of_right[9], left_from_right[9], right_center_mm[3];
} Rig;

static void times(const double *m, const double *v, double *out) {
  for (int r = 0; r < 3; r++) out[r] = m[3 * r] * v[0] + m[3 * r + 1] * v[1] + m[3 * r + 2] * v[2];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void unit_ray(const double *matrix, const double *px, double *ray) {
  double at[3] = {px[0], px[1], 1};
  times(matrix, at, ray);
  double length = sqrt(dot(ray, ray));
  for (int k = 0; k < 3; k++) ray[k] /= length;
}

static void unit_right_ray(const Rig *rig, const double *px, double *ray) {
  double own[3];
  unit_ray(rig->ray_of_right, px, own);
  times(rig->left_from_right, own, ray);
}

/* The midpoint of both rays' common perpendicular (Hartley & Sturm 1997, section 2.4); whether there is one. */
static int midpoint(const Rig *rig, const double *left, const double *right, double *point) {
  double cosine = dot(left, right), sine2 = 1 - cosine * cosine;
  if (sine2 < 1e-14) return 0;
  double along_left = dot(left, rig->right_center_mm), along_right = dot(right, rig->right_center_mm);
  double a = (along_left - cosine * along_right) / sine2, b = (cosine * along_left - along_right) / sine2;
  for (int k = 0; k < 3; k++) point[k] = (a * left[k] + rig->right_center_mm[k] + b * right[k]) / 2;
  return 1;
}

static int is_inside(const double *box, const double *point) {
  for (int k = 0; k < 3; k++)
    if (!(point[k] >= box[k] && point[k] <= box[3 + k])) return 0;
  return 1;
}

/* As a share of the step from one point of a line to the next. */
#define ENDS_MEET 1e-6
#define ENDS_NEAR_PX 1e-3

/* Where the epipolar lines of left points, lines (N, 3) of unit normals, cross right lines, for each pair of lines:
   pairs (count, 4) are the first and behind the last point of the left and of the right line. Found, in the box (lowest
   corner, highest corner), are: the left point, counted from the line's first, how far along the right line, in its
   points, where in both views, in space, and the sine of the angle; ends (count,): where each pair's stop. How many;
   beyond the capacity none is kept. */
EXPORT int32_t crossings(const Rig *rig, const double *left_px, const double *lines, const double *right_px,
                         const int64_t *pairs, int64_t count, const double *box, int64_t capacity, double *distance,
                         int64_t *left_at, double *right_at, double *crossed_left_px, double *crossed_right_px,
                         double *points_mm, double *sine, int64_t *ends) {
  int64_t found = 0;
  for (int64_t p = 0; p < count; p++) {
    const int64_t *range = pairs + 4 * p;
    const double *right = right_px + 2 * range[2];
    int64_t n = range[3] - range[2];
    for (int64_t i = range[0]; i < range[1]; i++) {
      double at[3] = {left_px[2 * i], left_px[2 * i + 1], 1}, left_ray[3];
      double a = lines[3 * i], b = lines[3 * i + 1], c = lines[3 * i + 2], least = INFINITY, most = -INFINITY;
      for (int64_t j = 0; j < n; j++) {
        double d = a * right[2 * j] + b * right[2 * j + 1] + c;
        distance[j] = d;
        least = d < least ? d : least;
        most = d > most ? d : most;
      }
      /* Most lines lie to one side of most epipolar lines, and their ends not near them. */
      if (least > ENDS_NEAR_PX || most < -ENDS_NEAR_PX) continue;
      int has_ray = 0;
      for (int64_t j = 0; j + 1 < n; j++) {
        double near = distance[j], far = distance[j + 1];
        if ((near < 0) == (far < 0) && j > 0 && j + 2 < n) continue;
        double share = near / (near - far);
        /* Ends of lines that are each other's partners meet, whatever rounding says. */
        int at_end = (j == 0 && fabs(share) < ENDS_MEET) || (j + 2 == n && fabs(share - 1) < ENDS_MEET);
        if ((near < 0) == (far < 0) && !at_end) continue;
        if (!has_ray) unit_ray(rig->ray_of_left, at, left_ray), has_ray = 1;
        double dx = right[2 * j + 2] - right[2 * j], dy = right[2 * j + 3] - right[2 * j + 1];
        double px[2] = {right[2 * j] + share * dx, right[2 * j + 1] + share * dy}, right_ray[3], point[3];
        unit_right_ray(rig, px, right_ray);
        if (!midpoint(rig, left_ray, right_ray, point) || !is_inside(box, point)) continue;
        if (found < capacity) {
          double step = sqrt(dx * dx + dy * dy);
          left_at[found] = i - range[0];
          right_at[found] = (double)j + share;
          memcpy(crossed_left_px + 2 * found, at, 2 * sizeof(double));
          memcpy(crossed_right_px + 2 * found, px, 2 * sizeof(double));
          memcpy(points_mm + 3 * found, point, 3 * sizeof(double));
          sine[found] = fabs(far - near) / (step > 1e-9 ? step : 1e-9);
        }
        found++;
      }
    }
    ends[p] = found;
  }
  return (int32_t)found;
}

/* The score of the best chain of crossings that goes along the right line one way (turn 1 or -1), and its last. */
static double follow(const int64_t *left_at, const double *right_at, const double *left_px, const double *points_mm,
                     const double *sine, int64_t n, double turn, double focal_px, double foreshortening,
                     double max_gap_mm, double *score, int64_t *previous, int64_t *last) {
  double most = -INFINITY;
  for (int64_t k = 0; k < n; k++) {
    double best = 0, z = points_mm[3 * k + 2];
    int64_t from = -1;
    for (int64_t j = 0; j < k; j++) {
      if (left_at[j] >= left_at[k] || !(turn * right_at[k] > turn * right_at[j])) continue;
      double u = left_px[2 * k] - left_px[2 * j], v = left_px[2 * k + 1] - left_px[2 * j + 1];
      double shown = sqrt(u * u + v * v) * z / focal_px;
      if (!(shown < max_gap_mm)) continue;
      double x = points_mm[3 * k] - points_mm[3 * j], y = points_mm[3 * k + 1] - points_mm[3 * j + 1];
      double w = z - points_mm[3 * j + 2], leap = sqrt(x * x + y * y + w * w);
      if (!(leap < foreshortening * shown)) continue;
      /* What a step costs: the left points that it skips, and the depth that it gains for nothing seen. */
      double gain = score[j] - 0.2 * (double)(left_at[k] - left_at[j] - 1) - 0.3 * (leap / shown - 1);
      if (gain > best) best = gain, from = j;
    }
    /* A crossing counts by how well it fixes the depth. */
    score[k] = sine[k] + 0.05 + best;
    previous[k] = from;
    if (score[k] > most) most = score[k], *last = k;
  }
  return most;
}

/* Of each group of crossings the longest chain that keeps order along both lines, the right one taken either way, and
   leaps nowhere in space: chosen, one behind the other, ends (groups,), and its score. starts, stops (groups,): which
   crossings are the group's. Chains of fewer than three are none. */
EXPORT void best_chains(const int64_t *left_at, const double *right_at, const double *left_px, const double *points_mm,
                        const double *sine, const int64_t *starts, const int64_t *stops, int64_t groups, double focal_px,
                        double foreshortening, double max_gap_mm, double *score, int64_t *previous, int64_t *chosen,
                        int64_t *ends, double *scores) {
  int64_t length = 0;
  for (int64_t g = 0; g < groups; g++) {
    int64_t first = starts[g], n = stops[g] - first;
    scores[g] = 0;
    ends[g] = length;
    if (n < 3) continue;
    int64_t last[2];
    double most[2];
    for (int way = 0; way < 2; way++)
      most[way] = follow(left_at + first, right_at + first, left_px + 2 * first, points_mm + 3 * first, sine + first, n,
                         way ? -1.0 : 1.0, focal_px, foreshortening, max_gap_mm, score + way * n, previous + way * n,
                         last + way);
    int way = most[1] > most[0];
    int64_t count = 0;
    for (int64_t k = last[way]; k >= 0; k = previous[way * n + k]) count++;
    if (count < 3) continue;
    int64_t at = length + count;
    for (int64_t k = last[way]; k >= 0; k = previous[way * n + k]) chosen[--at] = first + k;
    length += count;
    ends[g] = length;
    scores[g] = most[way];
  }
}

/* x of the symmetric system a x = b, by Cholesky's factors. */
static void solved(double a[4][4], double *b) {
  for (int i = 0; i < 4; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = a[i][j];
      for (int k = 0; k < j; k++) sum -= a[i][k] * a[j][k];
      a[i][j] = i == j ? sqrt(sum) : sum / a[j][j];
    }
    for (int k = 0; k < i; k++) b[i] -= a[i][k] * b[k];
    b[i] /= a[i][i];
  }
  for (int i = 3; i >= 0; i--) {
    for (int k = i + 1; k < 4; k++) b[i] -= a[k][i] * b[k];
    b[i] /= a[i][i];
  }
}

typedef struct {
  double across_px, ends_px, bend_prior[4], z_min_mm, z_max_mm, box[6];
} ByEnds;

/* Of each pair of lines the left one at the inverse depth, a cubic polynomial (Legendre) along it, that brings it onto
   the right one with its ends near that one's ends. pairs (count, 4) as for `crossings`; turned (count,): the right line
   is taken from its end. Kept are points that lie in the box and near the right line: the left point and the right one
   next to it, counted along each as taken, where it is seen on the right, and in space; ends (count,): where they stop.
   right_matrix and right_from_left (rotation, translation_mm) project; rays are of the left points. */
EXPORT void by_ends(const Rig *rig, const double *right_matrix, const double *right_rotation,
                    const double *translation_mm, const double *left_px, const double *right_px, const int64_t *pairs,
                    const uint8_t *turned, int64_t count, const ByEnds *limits, double *work, int64_t *left_at,
                    double *right_at, double *shown_px, double *points_mm, int64_t *ends) {
  double turn[9], to_right[9], near[3];
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++)
      turn[3 * r + c] = right_rotation[3 * r] * rig->ray_of_left[c] + right_rotation[3 * r + 1] * rig->ray_of_left[3 + c] +
                        right_rotation[3 * r + 2] * rig->ray_of_left[6 + c];
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++)
      to_right[3 * r + c] = right_matrix[3 * r] * turn[c] + right_matrix[3 * r + 1] * turn[3 + c] +
                            right_matrix[3 * r + 2] * turn[6 + c];
  times(right_matrix, translation_mm, near);
  int64_t found = 0;
  for (int64_t p = 0; p < count; p++) {
    const int64_t *range = pairs + 4 * p;
    const double *left = left_px + 2 * range[0];
    int64_t n = range[1] - range[0], m = range[3] - range[2];
    ends[p] = found;
    if (n < 3 || m < 2) continue;
    double *right = work, *far = right + 2 * m, *px = far + 3 * n, *q = px + 2 * n;
    for (int64_t j = 0; j < m; j++)
      memcpy(right + 2 * j, right_px + 2 * (turned[p] ? range[3] - 1 - j : range[2] + j), 2 * sizeof(double));
    double inverse[2];
    int is_near = 1;
    for (int e = 0; e < 2; e++) {
      double left_ray[3], right_ray[3], point[3];
      unit_ray(rig->ray_of_left, left + (e ? 2 * (n - 1) : 0), left_ray);
      unit_right_ray(rig, right + (e ? 2 * (m - 1) : 0), right_ray);
      /* Ends are traced too short or too long: the start may lie somewhat outside. */
      is_near = is_near && midpoint(rig, left_ray, right_ray, point) && point[2] > limits->z_min_mm / 1.5 &&
                point[2] < limits->z_max_mm * 1.5;
      if (is_near) inverse[e] = 1 / point[2];
    }
    if (!is_near) continue;
    double longest = 1e-9, c[4] = {(inverse[0] + inverse[1]) / 2, (inverse[1] - inverse[0]) / 2, 0, 0};
    for (int64_t j = 0; j + 1 < m; j++) {
      double dx = right[2 * j + 2] - right[2 * j], dy = right[2 * j + 3] - right[2 * j + 1];
      longest = fmax(longest, sqrt(dx * dx + dy * dy));
    }
    for (int64_t i = 0; i < n; i++) {
      double at[3] = {left[2 * i], left[2 * i + 1], 1};
      times(to_right, at, far + 3 * i);
    }
    for (int round = 0; round <= 5; round++) {
      double a[4][4] = {{0}}, b[4];
      for (int k = 0; k < 4; k++) a[k][k] = limits->bend_prior[k], b[k] = -limits->bend_prior[k] * c[k];
      for (int64_t i = 0; i < n; i++) {
        double s = -1 + 2 * (double)i / (double)(n - 1), l[4] = {1, s, 1.5 * s * s - 0.5, (2.5 * s * s - 1.5) * s};
        q[i] = c[0] + c[1] * l[1] + c[2] * l[2] + c[3] * l[3];
        double w = far[3 * i + 2] + q[i] * near[2];
        double x = (far[3 * i] + q[i] * near[0]) / w, y = (far[3 * i + 1] + q[i] * near[1]) / w;
        px[2 * i] = x, px[2 * i + 1] = y;
        if (round == 5) continue;
        double by_x = (near[0] - x * near[2]) / w, by_y = (near[1] - y * near[2]) / w, least = INFINITY;
        int64_t nearest = 0;
        for (int64_t j = 0; j + 1 < m; j++) {
          double u = x - (right[2 * j] + right[2 * j + 2]) / 2, v = y - (right[2 * j + 1] + right[2 * j + 3]) / 2;
          double d = u * u + v * v;
          if (d < least) least = d, nearest = j;
        }
        for (int is_end = 0; is_end < (i == 0 || i == n - 1 ? 2 : 1); is_end++) {
          int64_t j = !is_end ? nearest : i == 0 ? 0 : m - 2;
          double dx = right[2 * j + 2] - right[2 * j], dy = right[2 * j + 3] - right[2 * j + 1];
          double length = fmax(sqrt(dx * dx + dy * dy), 1e-9), sigma = is_end ? limits->ends_px : limits->across_px;
          /* Across the right line; at the ends along it as well. */
          double ux = (is_end ? dx : -dy) / length, uy = (is_end ? dy : dx) / length;
          const double *goal = right + 2 * (is_end && i > 0 ? m - 1 : j);
          double residual = ((goal[0] - x) * ux + (goal[1] - y) * uy) / sigma, row = (by_x * ux + by_y * uy) / sigma;
          double weight = 1 / (1 + residual * residual);
          for (int k = 0; k < 4; k++) {
            b[k] += weight * residual * row * l[k];
            for (int h = 0; h <= k; h++) a[k][h] += weight * row * row * l[k] * l[h];
          }
        }
      }
      if (round < 5) {
        solved(a, b);
        for (int k = 0; k < 4; k++) c[k] += b[k];
      }
    }
    for (int64_t i = 0; i < n; i++) {
      double at[3] = {left[2 * i], left[2 * i + 1], 1}, ray[3], point[3], least = INFINITY;
      times(rig->ray_of_left, at, ray);
      for (int k = 0; k < 3; k++) point[k] = ray[k] / q[i];
      int64_t nearest = 0;
      for (int64_t j = 0; j < m; j++) {
        double u = px[2 * i] - right[2 * j], v = px[2 * i + 1] - right[2 * j + 1], d = u * u + v * v;
        if (d < least) least = d, nearest = j;
      }
      if (!is_inside(limits->box, point) || !(sqrt(least) < 2 * longest)) continue;
      left_at[found] = i;
      right_at[found] = (double)nearest;
      memcpy(shown_px + 2 * found, px + 2 * i, 2 * sizeof(double));
      memcpy(points_mm + 3 * found, point, 3 * sizeof(double));
      found++;
    }
    if (found - ends[p] < 3) found = ends[p];
    ends[p] = found;
  }
}

/* How much of the places (n,) on a line lies within the stretches, lowest to highest, of those taken on that line. */
static double share_of(const double *at, int64_t n, int64_t line, const int64_t *taken, int64_t count,
                       const int64_t *lines, const double *low, const double *high) {
  int64_t within = 0;
  for (int64_t k = 0; k < n; k++)
    for (int64_t t = 0; t < count; t++) {
      int64_t other = taken[t];
      if (lines[other] == line && at[k] >= low[other] && at[k] <= high[other]) {
        within++;
        break;
      }
    }
  return (double)within / (double)n;
}

/* Chains, the best first, on lines (2, chains), left and right: places (2, all) from starts to stops, which reach from
   low to high (2, chains). Those become each other's partners of which no more than half of either stretch is taken
   before; gone are those of them that are marked. How many. */
EXPORT int32_t gone_elsewhere(const int64_t *lines, const double *places, int64_t all, const int64_t *starts,
                              const int64_t *stops, const double *low, const double *high, const uint8_t *marked,
                              int64_t chains, int64_t *taken, int64_t *gone) {
  int64_t count = 0, lost = 0;
  for (int64_t i = 0; i < chains; i++) {
    int is_taken = 0;
    for (int side = 0; side < 2 && !is_taken; side++)
      is_taken = share_of(places + side * all + starts[i], stops[i] - starts[i], lines[side * chains + i], taken, count,
                          lines + side * chains, low + side * chains, high + side * chains) > 0.5;
    if (is_taken) continue;
    taken[count++] = i;
    if (marked[i]) gone[lost++] = i;
  }
  return (int32_t)lost;
}

/* How much of chains' stretches (2, chains) lies within those of others that are gone: lines (2, gone), low, high. */
EXPORT void shares_gone(const int64_t *lines, const double *places, int64_t all, const int64_t *starts,
                        const int64_t *stops, int64_t chains, const int64_t *gone_lines, const double *low,
                        const double *high, int64_t gone, int64_t *each, double *shares) {
  for (int64_t t = 0; t < gone; t++) each[t] = t;
  for (int64_t i = 0; i < chains; i++)
    for (int side = 0; side < 2; side++)
      shares[side * chains + i] =
          share_of(places + side * all + starts[i], stops[i] - starts[i], lines[side * chains + i], each, gone,
                   gone_lines + side * gone, low + side * gone, high + side * gone);
}
