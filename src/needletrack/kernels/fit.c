/* One spline for both views: linearised, weighed and solved (`tracking/fit.py` says what and why).

   Control points are 3 m numbers in a row. An offset concerns four control points: a row of the system is kept as its
   12 numbers and the first of these four. */
#include "kernels.h"

#define ROW 12

/* Offset that a point misses along `ahead` from where it was seen, and its derivative (3,) by the point. */
static double missed(const Camera *c, const double *p, double at_x, double at_y, const double *ahead, double *by) {
  double length = sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]);
  length = length > 1e-12 ? length : 1e-12;
  double nx = ahead[0] / length, ny = ahead[1] / length;
  const double *r = c->rotation, *t = c->translation_mm;
  double x = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + t[0], y = r[3] * p[0] + r[4] * p[1] + r[5] * p[2] + t[1],
         z = r[6] * p[0] + r[7] * p[1] + r[8] * p[2] + t[2];
  double u = x / z, v = y / z;
  double off = (at_x - (c->fx * u + c->skew * v + c->cx)) * nx + (at_y - (c->fy * v + c->cy)) * ny;
  double bx = nx * c->fx / z, by_ = (nx * c->skew + ny * c->fy) / z, bz = -(bx * u + by_ * v);
  for (int k = 0; k < 3; k++) by[k] = bx * r[k] + by_ * r[3 + k] + bz * r[6 + k];
  return off;
}

static void row_of(const double *mixing, const double *by, double *row) {
  for (int a = 0; a < 4; a++)
    for (int k = 0; k < 3; k++) row[3 * a + k] = mixing[a] * by[k];
}

static double dot(const double *a, const double *b, int64_t n) {
  double sum = 0;
  for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

#define LANES 4
#define TILE (2 * LANES)

typedef double Lanes __attribute__((vector_size(8 * LANES), aligned(8), may_alias));

/* One tile of `take_away`: columns `at` to at + TILE of four rows, of which those before `from` stay as they are. */
static inline void take_tile(const double *x, int64_t next, int64_t down, const double *y, int64_t count, double *out,
                             int64_t columns, int64_t at, int64_t from) {
  Lanes sums[4][2] = {{{0}}};
  for (int64_t k = 0; k < count; k++) {
    const Lanes *row = (const Lanes *)(y + k * columns + at);
    Lanes left = row[0], right = row[1];
    for (int r = 0; r < 4; r++) {
      double share = x[k * next + r * down];
      sums[r][0] += share * left, sums[r][1] += share * right;
    }
  }
  for (int r = 0; r < 4; r++) {
    double *mine = out + r * columns + at;
    if (at == from) {
      for (int q = 0; q < 2; q++) *(Lanes *)(mine + LANES * q) -= sums[r][q];
      continue;
    }
    for (int64_t k = from - at; k < TILE; k++) mine[k] -= sums[r][k / LANES][k % LANES];
  }
}

/* Takes x y from `rows` rows of out, from column `from` on; x (rows, count): its columns are `next` apart and its rows
   `down`; y (count, columns). Four rows and eight columns of sums stay in registers: what is read serves all of them. */
static void take_away(const double *x, int64_t next, int64_t down, const double *y, int64_t count, double *out,
                      int64_t rows, int64_t columns, int64_t from) {
  int64_t r = 0;
  for (; r + 4 <= rows && columns >= TILE; r += 4)
    for (int64_t at = from; at < columns; at += TILE)
      take_tile(x + r * down, next, down, y, count, out + r * columns, columns,
                at + TILE <= columns ? at : columns - TILE, at);
  for (; r < rows; r++)
    for (int64_t k = 0; k < count; k++) {
      double share = x[k * next + r * down];
      for (int64_t j = from; j < columns; j++) out[r * columns + j] -= share * y[k * columns + j];
    }
}

/* The Cholesky factor U of U'U, in place of its upper triangle, the diagonal as its inverse; 1 where the matrix is not
   positive definite. Below the diagonal nothing is read, and what is there has no meaning afterwards. */
static int factored(double *a, int64_t n) {
  for (int64_t first = 0; first < n; first += 4) {
    int64_t last = first + 4 < n ? first + 4 : n;
    take_away(a + first, n, 1, a, first, a + first * n, last - first, n, first);
    for (int64_t i = first; i < last; i++) {
      double *mine = a + i * n;
      if (!(mine[i] > 0)) return 1;
      double over = 1 / sqrt(mine[i]);
      mine[i] = over;
      for (int64_t j = i + 1; j < n; j++) mine[j] *= over;
      for (int64_t next = i + 1; next < last; next++) {
        double *other = a + next * n, share = mine[next];
        for (int64_t j = next; j < n; j++) other[j] -= share * mine[j];
      }
    }
  }
  return 0;
}

static void forward(const double *u, int64_t n, double *b) {
  for (int64_t i = 0; i < n; i++) {
    double mine = b[i] *= u[i * n + i];
    for (int64_t j = i + 1; j < n; j++) b[j] -= u[i * n + j] * mine;
  }
}

static void backward(const double *u, int64_t n, double *b) {
  for (int64_t i = n - 1; i >= 0; i--)
    b[i] = (b[i] - dot(u + i * n + i + 1, b + i + 1, n - 1 - i)) * u[i * n + i];
}

/* The same for right sides (n, r) at once. */
static void forward_all(const double *u, int64_t n, double *b, int64_t r) {
  for (int64_t first = 0; first < n; first += 4) {
    int64_t last = first + 4 < n ? first + 4 : n;
    take_away(u + first, n, 1, b, first, b + first * r, last - first, r, 0);
    for (int64_t i = first; i < last; i++) {
      double *mine = b + i * r;
      take_away(u + first * n + i, n, 1, b + first * r, i - first, mine, 1, r, 0);
      for (int64_t k = 0; k < r; k++) mine[k] *= u[i * n + i];
    }
  }
}

static void backward_all(const double *u, int64_t n, double *b, int64_t r) {
  for (int64_t last = n; last > 0; last -= 4) {
    int64_t first = last > 4 ? last - 4 : 0;
    take_away(u + first * n + last, 1, n, b + last * r, n - last, b + first * r, last - first, r, 0);
    for (int64_t i = last - 1; i >= first; i--) {
      double *mine = b + i * r;
      take_away(u + i * n + i + 1, 1, n, b + (i + 1) * r, last - 1 - i, mine, 1, r, 0);
      for (int64_t k = 0; k < r; k++) mine[k] *= u[i * n + i];
    }
  }
}

static void curve_of(const double *control, const int64_t *first, const double *mixing, int64_t n, double *points) {
  for (int64_t i = 0; i < n; i++)
    for (int k = 0; k < 3; k++) {
      double sum = 0;
      for (int a = 0; a < 4; a++) sum += mixing[4 * i + a] * control[3 * (first[i] + a) + k];
      points[3 * i + k] = sum;
    }
}

/* Points (n, 3) of a spline of control points (m, 3). */
EXPORT void curve(const double *control, const int64_t *first, const double *mixing, int64_t n, double *points) {
  curve_of(control, first, mixing, n, points);
}

static inline double matern(double scaled) { return (1 + scaled) * exp_negative_precise(-scaled); }

/* A streak's line, about points (n, 3): its weights and its normal matrix (see `fit._Line`), and the Cholesky factor of
   what was expected of it, (lines, lines), in `expected`.

   at_mm, along (lines, 3): where on the needle, and which way it runs there; variance (lines,) px^2 of each place.
   shares = (streak, change, bend); robust in sigmas. work: room for (lines + 3 m + 4) * lines. Returns 1 where it fails. */
EXPORT int streak_line(const Sight *s, const double *points, const int64_t *first, const double *mixing, int64_t m,
                       const double *at_mm, const double *along, const double *variance, double radius_px,
                       const double *shares, double change_mm, double robust, double *expected, double *work) {
  int64_t count = s->lines, size = 3 * m;
  double *jumping = work, *residual = jumping + count * count, *own = residual + count, *rows = own + count;
  double scale = radius_px * radius_px, level = shares[0] * shares[0], slowly = shares[1] * shares[1],
         bending = shares[2] * shares[2];
  for (int64_t i = 0; i < count; i++) {
    for (int64_t j = 0; j <= i; j++) {
      double alike = dot(along + 3 * i, along + 3 * j, 3), turned = 2 - 2 * alike;
      double apart = 1.7320508075688772 * fabs(at_mm[i] - at_mm[j]) / change_mm;
      double turn = 1.7320508075688772 * sqrt(turned > 0 ? turned : 0);
      jumping[j * count + i] = expected[j * count + i] =
          scale * (level + slowly * matern(apart) + bending * matern(turn));
    }
    expected[i * count + i] += variance[i];
  }
  if (factored(expected, count)) return 1;
  for (int64_t i = 0; i < count; i++) {
    int64_t at = s->line_index[i];
    double by[3];
    const double *h = s->here_px + 2 * at, *d = s->ahead + 2 * at;
    residual[i] = missed(s->camera, points + 3 * at, h[0] + s->line_offset_px[i] * d[0],
                         h[1] + s->line_offset_px[i] * d[1], d, by);
    row_of(mixing + 4 * at, by, rows + ROW * i);
  }
  memcpy(own, residual, (size_t)count * sizeof *own);
  forward(expected, count, own);
  backward(expected, count, own);
  /* What jumps off the line is not of it. */
  for (int64_t i = 0; i < count; i++) {
    double off = variance[i] * own[i];
    jumping[i * count + i] += variance[i] * (1 + off * off / (robust * robust * variance[i]));
  }
  if (factored(jumping, count)) return 1;
  double *weighted = s->line_weighted;
  memset(weighted, 0, (size_t)(count * size) * sizeof *weighted);
  for (int64_t i = 0; i < count; i++)
    memcpy(weighted + i * size + 3 * first[s->line_index[i]], rows + ROW * i, ROW * sizeof *rows);
  forward_all(jumping, count, weighted, size);
  backward_all(jumping, count, weighted, size);
  memset(s->line_normal, 0, (size_t)(size * size) * sizeof(double));
  for (int64_t i = 0; i < count; i++)
    for (int k = 0; k < ROW; k++) {
      double *mine = s->line_normal + (3 * first[s->line_index[i]] + k) * size, share = rows[ROW * i + k];
      const double *other = weighted + i * size;
      for (int64_t j = 0; j < size; j++) mine[j] += share * other[j];
    }
  return 0;
}

/* Mean squared offset left over of a streak about points (n, 3), in what was `expected` of it (its Cholesky factor). */
EXPORT double streak_misfit(const Sight *s, const double *points, const double *expected, double *work) {
  for (int64_t i = 0; i < s->lines; i++) {
    int64_t at = s->line_index[i];
    double by[3];
    const double *h = s->here_px + 2 * at, *d = s->ahead + 2 * at;
    work[i] = missed(s->camera, points + 3 * at, h[0] + s->line_offset_px[i] * d[0],
                     h[1] + s->line_offset_px[i] * d[1], d, by);
  }
  forward(expected, s->lines, work);
  return dot(work, work, s->lines) / (double)s->lines;
}

static double product(const double *row, const double *vector) { return dot(row, vector, ROW); }

/* What a view measures of a curve that is now at points (n, 3) and has moved (3 m,) since its start. */
static void measured(Sight *s, const double *points, const int64_t *first, const double *mixing, int64_t n,
                     const double *moved) {
  s->count = 0;
  for (int64_t i = 0; i < n; i++) {
    if (!isfinite(s->sigma_px[i])) continue;
    int64_t at = s->count++;
    double by[3];
    const double *h = s->here_px + 2 * i, *d = s->ahead + 2 * i;
    s->index[at] = i, s->sigma[at] = s->sigma_px[i];
    double off = missed(s->camera, points + 3 * i, h[0] + s->offset_px[i] * d[0], h[1] + s->offset_px[i] * d[1], d, by);
    row_of(mixing + 4 * i, by, s->rows + ROW * at);
    s->residual[at] = off + product(s->rows + ROW * at, moved + 3 * first[i]);
  }
  for (int64_t e = 0; e < s->ends; e++) {
    int64_t at = s->count++, i = s->end_index[e];
    double by[3];
    s->index[at] = i, s->sigma[at] = s->end_sigma_px[e];
    double off = missed(s->camera, points + 3 * i, s->end_here_px[2 * e], s->end_here_px[2 * e + 1],
                        s->end_ahead + 2 * e, by);
    row_of(mixing + 4 * i, by, s->rows + ROW * at);
    s->residual[at] = off + product(s->rows + ROW * at, moved + 3 * first[i]);
  }
}

/* Adds the weighted outer products of rows (count, ROW) to the block (ROW, ROW) of a matrix of `size` columns. */
static void add_squares(const double *rows, const double *weight, int64_t count, double *block, int64_t size) {
  for (int a = 0; a < ROW; a += 4) {
    Lanes sums[4][ROW / LANES] = {{{0}}};
    for (int64_t i = 0; i < count; i++) {
      const double *row = rows + ROW * i;
      for (int r = 0; r < 4; r++) {
        double share = weight[i] * row[a + r];
        for (int q = 0; q < ROW / LANES; q++) sums[r][q] += share * *(const Lanes *)(row + LANES * q);
      }
    }
    for (int r = 0; r < 4; r++)
      for (int q = 0; q < ROW / LANES; q++) *(Lanes *)(block + (a + r) * size + LANES * q) += sums[r][q];
  }
}

/* One step of Gauss-Newton of the control points (3 m,) from where they are, robust weights settled in rounds.

   held, smooth (3 m, 3 m): the priors' matrices. share: of a point of its own in an independent one. normal (3 m, 3 m):
   out. work: room for 3 n + 3 m (6 m + 4). Returns 1 where one of the views shows nothing, 2 where nothing holds it. */
EXPORT int approach(Sight *sights, int64_t n, int64_t m, const int64_t *first, const double *mixing,
                    const double *start, double *control, const double *held, const double *smooth, double share,
                    double robust_px, int64_t rounds, double *normal, double *work) {
  int64_t size = 3 * m;
  double *points = work, *fixed = points + 3 * n, *moved = fixed + size * size, *pull = moved + size,
         *step = pull + size, *target = step + size, *factor = target + size;
  for (int64_t k = 0; k < size; k++) moved[k] = control[k] - start[k];
  curve_of(control, first, mixing, n, points);
  memcpy(fixed, held, (size_t)(size * size) * sizeof *fixed);
  for (int64_t k = 0; k < size; k++) pull[k] = -dot(smooth + k * size, start, size);
  for (int v = 0; v < 2; v++) {
    Sight *s = sights + v;
    measured(s, points, first, mixing, n, moved);
    if (s->count == s->ends) return 1;
    if (!s->lines) continue;
    for (int64_t k = 0; k < size * size; k++) fixed[k] += s->line_normal[k];
    for (int64_t k = 0; k < size; k++) pull[k] += dot(s->line_normal + k * size, moved, size);
    for (int64_t i = 0; i < s->lines; i++) {
      int64_t at = s->line_index[i];
      double by[3];
      const double *h = s->here_px + 2 * at, *d = s->ahead + 2 * at, *weights = s->line_weighted + i * size;
      double off = missed(s->camera, points + 3 * at, h[0] + s->line_offset_px[i] * d[0],
                          h[1] + s->line_offset_px[i] * d[1], d, by);
      for (int64_t k = 0; k < size; k++) pull[k] += off * weights[k];
    }
  }
  memcpy(step, moved, (size_t)size * sizeof *step);
  for (int64_t round = 0; round < rounds; round++) {
    memcpy(normal, fixed, (size_t)(size * size) * sizeof *normal);
    memcpy(target, pull, (size_t)size * sizeof *target);
    for (int v = 0; v < 2; v++) {
      Sight *s = sights + v;
      for (int64_t i = 0; i < s->count; i++) {
        const double *row = s->rows + ROW * i;
        int64_t at = 3 * first[s->index[i]];
        double sigma = s->sigma[i], off = s->residual[i] - product(row, step + at);
        double scaled = off / (robust_px > sigma ? robust_px : sigma);
        double weight = (i < s->count - s->ends ? share : 1.0) / (sigma * sigma) / (1 + scaled * scaled);
        s->weight[i] = weight;
        double pulled = weight * s->residual[i];
        for (int a = 0; a < ROW; a++) target[at + a] += pulled * row[a];
      }
      for (int64_t i = 0, next; i < s->count; i = next) {
        /* Neighbours mostly concern the same control points. */
        int64_t at = first[s->index[i]];
        for (next = i + 1; next < s->count && first[s->index[next]] == at;) next++;
        add_squares(s->rows + ROW * i, s->weight + i, next - i, normal + 3 * at * (size + 1), size);
      }
    }
    memcpy(step, target, (size_t)size * sizeof *step);
    memcpy(factor, normal, (size_t)(size * size) * sizeof *factor);
    if (factored(factor, size)) return 2;
    forward(factor, size, step);
    backward(factor, size, step);
  }
  for (int64_t k = 0; k < size; k++) control[k] = start[k] + step[k];
  for (int64_t k = 0; k < size; k++)
    if (!isfinite(control[k])) return 2;
  return 0;
}

/* Covariance (3 m, 3 m) of control points that came of `approach`, and what is left over.

   residual_px (2, n): NaN where not seen. systematic (2,): variance, px^2, of what pulls each view's axis aside alike
   over systematic_mm (Huber's sandwich); 0 leaves it out. length_mm (n,). rms_px: out. work: room for 4 (3 m)^2.
   Returns 2 where nothing holds the curve. */
EXPORT int fit_covariance(const Sight *sights, int64_t n, int64_t m, const int64_t *first, const double *start,
                          const double *control, const double *normal, const double *length_mm,
                          const double *systematic, double systematic_mm, double *residual_px, double *rms_px,
                          double *covariance, double *work) {
  int64_t size = 3 * m;
  double *spread = work, *factor = spread + size * size, *pulled = factor + size * size,
         *carried = pulled + size * size, misfit = 0, precision = 0, count = 0;
  double *moved = carried;
  for (int64_t k = 0; k < size; k++) moved[k] = control[k] - start[k];
  for (int64_t k = 0; k < 2 * n; k++) residual_px[k] = NAN;
  for (int v = 0; v < 2; v++)
    for (int64_t i = 0; i < sights[v].count; i++) {
      const Sight *s = sights + v;
      double left = s->residual[i] - product(s->rows + ROW * i, moved + 3 * first[s->index[i]]);
      if (i < s->count - s->ends) residual_px[v * n + s->index[i]] = left;
      misfit += left * left / (s->sigma[i] * s->sigma[i]), precision += 1 / (s->sigma[i] * s->sigma[i]), count++;
    }
  *rms_px = sqrt(misfit / precision);
  double excess = misfit / count > 1 ? misfit / count : 1;
  memcpy(factor, normal, (size_t)(size * size) * sizeof *factor);
  if (factored(factor, size)) return 2;
  memset(spread, 0, (size_t)(size * size) * sizeof *spread);
  for (int64_t k = 0; k < size; k++) spread[k * size + k] = 1;
  forward_all(factor, size, spread, size);
  backward_all(factor, size, spread, size);
  for (int64_t k = 0; k < size * size; k++) covariance[k] = excess * spread[k];
  if (!(systematic[0] > 0) && !(systematic[1] > 0)) return 0;
  memset(pulled, 0, (size_t)(size * size) * sizeof *pulled);
  for (int v = 0; v < 2; v++) {
    const Sight *s = sights + v;
    memset(carried, 0, (size_t)size * sizeof *carried);
    double before = 0;
    int64_t reached = 0;
    for (int64_t i = 0; i < s->count - s->ends; i++) {
      /* Errors alike by exp(-distance) are a Markov chain: what all sections before pull is carried along. */
      double at = length_mm[s->index[i]], fade = i ? exp(-(at - before) / systematic_mm) : 0;
      const double *row = s->rows + ROW * i;
      int64_t here = 3 * first[s->index[i]];
      before = at;
      for (int64_t k = 0; k < reached; k++) carried[k] *= fade;
      for (int a = 0; a < ROW; a++) {
        double w = systematic[v] * s->weight[i] * row[a], *mine = pulled + (here + a) * size;
        for (int64_t k = 0; k < reached; k++) mine[k] += w * carried[k];
        for (int b = 0; b < ROW; b++) mine[here + b] += w * s->weight[i] * row[b] / 2;
      }
      for (int a = 0; a < ROW; a++) carried[here + a] += s->weight[i] * row[a];
      reached = here + ROW > reached ? here + ROW : reached;
    }
  }
  /* Each pair was counted once: the other half is its mirror image. */
  for (int64_t i = 0; i < size; i++)
    for (int64_t j = 0; j <= i; j++)
      factor[i * size + j] = factor[j * size + i] = pulled[i * size + j] + pulled[j * size + i];
  memset(pulled, 0, (size_t)(size * size) * sizeof *pulled);
  take_away(spread, 1, size, factor, size, pulled, size, size, 0);
  take_away(pulled, 1, size, spread, size, covariance, size, size, 0);
  for (int64_t i = 0; i < size; i++)
    for (int64_t j = 0; j < i; j++) covariance[i * size + j] = covariance[j * size + i];
  return 0;
}

/* Covariance (n, 3, 3) of points of a spline whose control points have covariance (3 m, 3 m). */
EXPORT void point_covariance(const double *covariance, int64_t m, const int64_t *first, const double *mixing, int64_t n,
                             double *out) {
  int64_t size = 3 * m;
  for (int64_t i = 0; i < n; i++)
    for (int a = 0; a < 3; a++)
      for (int b = 0; b < 3; b++) {
        double sum = 0;
        for (int p = 0; p < 4; p++)
          for (int q = 0; q < 4; q++)
            sum += mixing[4 * i + p] * mixing[4 * i + q] *
                   covariance[(3 * (first[i] + p) + a) * size + 3 * (first[i] + q) + b];
        out[9 * i + 3 * a + b] = sum;
      }
}

static void add_outer(double *matrix, int64_t size, int64_t at, const double *mixing, double weight) {
  for (int a = 0; a < 4; a++)
    for (int b = 0; b < 4; b++)
      for (int k = 0; k < 3; k++) matrix[(at + 3 * a + k) * size + at + 3 * b + k] += weight * mixing[a] * mixing[b];
}

/* The control points (3 m,) nearest to points (n, 3), and the matrices (3 m, 3 m) of what is known beforehand.

   priors = (curvature change 1/mm^2, curvature motion 1/(mm s), its correlation mm, noise's correlation mm, how far
   the points may slide along the curve mm). smooth: of the change of curvature alone; held: that and all the rest.
   bent_for_s: how long ago the needle was bent like the points; 0: it was not. work: room for 4 n + 4 m + m (m + 3).
   Returns 1 where the points hold no curve. */
EXPORT int start_of_fit(const double *points, const double *length_mm, int64_t n, int64_t m, const int64_t *first,
                        const double *mixing, const double *priors, double bent_for_s, double *start, double *held,
                        double *smooth, double *work) {
  int64_t size = 3 * m;
  double whole = length_mm[n - 1], *place = work, *values = place + n, *normal = values + 4 * (n > m ? n : m),
         *target = normal + m * m;
  int64_t at[n > m ? n : m];
  memset(normal, 0, (size_t)(m * (m + 3)) * sizeof *normal);
  for (int64_t i = 0; i < n; i++)
    for (int a = 0; a < 4; a++) {
      for (int b = 0; b < 4; b++)
        normal[(first[i] + a) * m + first[i] + b] += mixing[4 * i + a] * mixing[4 * i + b];
      for (int k = 0; k < 3; k++) target[3 * (first[i] + a) + k] += mixing[4 * i + a] * points[3 * i + k];
    }
  /* Where the points are too few for so many control points these stay near one another. */
  for (int64_t k = 0; k < m; k++) normal[k * m + k] += 1e-12;
  if (factored(normal, m)) return 1;
  forward_all(normal, m, target, 3);
  backward_all(normal, m, target, 3);
  memcpy(start, target, (size_t)size * sizeof *start);
  memset(smooth, 0, (size_t)(size * size) * sizeof *smooth);
  for (int64_t k = 0; k < m - 3; k++) place[k] = ((double)k + 0.5) / (double)(m - 3);
  basis(place, m - 3, m, 3, at, values);
  double change = priors[0] * whole * whole * whole;
  for (int64_t k = 0; k < m - 3; k++) add_outer(smooth, size, 3 * at[k], values + 4 * k, 1 / (change * change));
  memcpy(held, smooth, (size_t)(size * size) * sizeof *held);
  if (bent_for_s > 0) {
    double motion = priors[1] * bent_for_s, weight = whole / (double)n / priors[2] / (motion * motion);
    for (int64_t i = 0; i < n; i++) place[i] = length_mm[i] / whole;
    basis(place, n, m, 2, at, values);
    weight /= whole * whole * whole * whole;
    for (int64_t i = 0; i < n; i++) add_outer(held, size, 3 * at[i], values + 4 * i, weight);
  }
  double per_point = whole / (double)n / priors[3] / (priors[4] * priors[4]);
  for (int64_t i = 0; i < n; i++) {
    const double *a = points + 3 * (i > 0 ? i - 1 : 0), *b = points + 3 * (i + 1 < n ? i + 1 : n - 1);
    double along[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, row[ROW];
    double length = sqrt(dot(along, along, 3));
    for (int k = 0; k < 3; k++) along[k] /= length > 1e-300 ? length : 1e-300;
    row_of(mixing + 4 * i, along, row);
    for (int p = 0; p < ROW; p++)
      for (int q = 0; q < ROW; q++)
        held[(3 * first[i] + p) * size + 3 * first[i] + q] += per_point * row[p] * row[q];
  }
  /* Everything is held to a metre: never singular. */
  for (int64_t k = 0; k < size; k++) held[k * size + k] += 1e-6;
  return 0;
}

/* Values of the four basis functions (n, 4) of a clamped cubic B-spline of m control points on [0, 1] that are not 0 at
   u (n,), or their derivative of that order, and which the first is (de Boor 1978, algorithm A2.2 of Piegl & Tiller). */
EXPORT void basis(const double *u, int64_t n, int64_t m, int64_t derivative, int64_t *first, double *mixing) {
  double spans = (double)(m - 3);
  for (int64_t i = 0; i < n; i++) {
    double at = u[i] < 0 ? 0 : u[i] > 1 ? 1 : u[i];
    int64_t span = (int64_t)(at * spans);
    span = span > m - 4 ? m - 4 : span;
    /* Of rounding: the span is the one whose knots lie about the place. */
    while (span > 0 && at < (double)span / spans) span--;
    while (span < m - 4 && at >= (double)(span + 1) / spans) span++;
    first[i] = span;
    double knots[8];
    for (int k = 0; k < 8; k++) {
      double at_knot = (double)(span + k - 3) / spans;
      knots[k] = at_knot < 0 ? 0 : at_knot > 1 ? 1 : at_knot;
    }
    /* Columns of basis functions by degree; derivatives are differences of those of one degree less. */
    double values[4] = {0, 0, 0, 1};
    int64_t degree_of_values = 3 - derivative;
    for (int64_t degree = 1; degree <= 3; degree++) {
      double next[4] = {0, 0, 0, 0};
      for (int k = 3 - (int)degree; k < 4; k++) {
        double low = knots[k + degree] - knots[k], high = knots[k + 1 + degree] - knots[k + 1];
        if (degree <= degree_of_values) {
          if (low > 0) next[k] += (at - knots[k]) / low * values[k];
          if (k < 3 && high > 0) next[k] += (knots[k + degree + 1] - at) / high * values[k + 1];
        } else {
          if (low > 0) next[k] += (double)degree / low * values[k];
          if (k < 3 && high > 0) next[k] -= (double)degree / high * values[k + 1];
        }
      }
      memcpy(values, next, sizeof values);
    }
    memcpy(mixing + 4 * i, values, sizeof values);
  }
}
