/* Ends of a needle tried in a straightened picture: see `tracking/tip.py`. */
#include "kernels.h"

#define PLANES 7
#define MOST 32

/* Least of the mean squared differences of two profiles (n,), the other shifted by up to `most` rows, with its price. */
static int64_t best_lag(const double *one, const double *other, int64_t n, int64_t most, double price) {
  int64_t best = 0;
  double least = INFINITY;
  for (int64_t lag = -most; lag <= most; lag++) {
    int64_t ahead = lag > 0 ? lag : 0, behind = lag < 0 ? -lag : 0, count = n - ahead - behind;
    double sum = 0;
    for (int64_t i = 0; i < count; i++) {
      double off = one[behind + i] - other[ahead + i];
      sum += off * off;
    }
    double cost = sum / (double)count + price * (double)(lag * lag);
    if (cost < least) least = cost, best = lag;
  }
  return best;
}

static double between(const double *v, int64_t n, double at) {
  if (at <= 0) return v[0];
  if (at >= (double)(n - 1)) return v[n - 1];
  int64_t i = (int64_t)at;
  return v[i] + (at - (double)i) * (v[i + 1] - v[i]);
}

/* The picture (n, count) between columns left and right replaced by the profiles there, shifted along from one to the
   other by `lag` rows. share (count,): how far each column lies on the way. */
static void filled(double *picture, int64_t n, int64_t count, int64_t left, int64_t right, int64_t lag,
                   const double *share, const double *one, const double *other) {
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = left + 1; k < right; k++) {
      double t = share[k];
      picture[i * count + k] = between(one, n, (double)i - (double)lag * t) * (1 - t) +
                               between(other, n, (double)i + (double)lag * (1 - t)) * t;
    }
}

static double dot(const double *a, const double *b, int64_t n) {
  double sum = 0;
  for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* What is the same wherever the apex is, of the pictures of one shape of end: see `pictures_of`. */
typedef struct {
  const double *pictures, *own; /* (distances, parts, width), and the parts' products (distances, parts, parts) */
  const uint8_t *extent;        /* (distances, parts, 2): the columns from which to which a part shows there */
} Shape;

#define KINDS (PLANES + 1)
/* What the planes need to know of a part's picture: its sums with 1, x and x^2. */
#define MOMENTS 3
#define LANES 4

typedef double Lanes __attribute__((vector_size(8 * LANES), aligned(8), may_alias));

static int64_t whole_lanes(int64_t count) { return (count + LANES - 1) / LANES * LANES; }

/* Adds what one row of the view, which shows row `at` of the pictures, says: by planes and grey, and by itself. */
static void add_row(const Shape *shape, int64_t at, int64_t parts, const double *weighted, const double *weight,
                    int64_t width, double *mixed, double *own) {
  const double *inside = shape->pictures + at * parts * width;
  const uint8_t *extent = shape->extent + 2 * at * parts;
  double part[64];
  for (int64_t p = 0; p < parts; p++) {
    const double *mine = inside + p * width;
    for (int64_t k = extent[2 * p]; k < extent[2 * p + 1]; k++)
      for (int q = 0; q < KINDS; q++) mixed[p * KINDS + q] += mine[k] * weighted[k * KINDS + q];
    if (extent[2 * p] >= extent[2 * p + 1]) continue;
    for (int64_t k = 0; k < width; k++) part[k] = mine[k] * weight[k];
    for (int64_t o = 0; o <= p; o++) own[p * parts + o] += dot(part, inside + o * width, width);
  }
}

/* Adds to sums (2,), lane by lane, a part's picture (width,) times two rows (2, width), where it shows. */
static inline void add_shown(const double *picture, const uint8_t *extent, const double *rows, int64_t width,
                             Lanes *sums) {
  static const double keep[2 * LANES] = {1, 1, 1, 1};
  int64_t k = extent[0], last = extent[1];
  if (k >= last) return;
  if (k + whole_lanes(last - k) > width) {
    for (; k < last; k++) sums[0][0] += picture[k] * rows[k], sums[1][0] += picture[k] * rows[width + k];
    return;
  }
  Lanes one = sums[0], other = sums[1];
  for (; k + LANES < last; k += LANES) {
    Lanes shown = *(const Lanes *)(picture + k);
    one += shown * *(const Lanes *)(rows + k), other += shown * *(const Lanes *)(rows + width + k);
  }
  Lanes shown = *(const Lanes *)(picture + k) * *(const Lanes *)(keep + LANES - (last - k));
  sums[0] = one + shown * *(const Lanes *)(rows + k), sums[1] = other + shown * *(const Lanes *)(rows + width + k);
}

/* The parts' products (distances, parts, parts) in pictures (distances, parts, width), and the columns
   (distances, parts, 2) from which to which each shows. */
EXPORT void pictures_of(const double *pictures, int64_t distances, int64_t parts, int64_t width, double *own,
                        uint8_t *extent) {
  for (int64_t i = 0; i < distances; i++) {
    const double *row = pictures + i * parts * width;
    for (int64_t p = 0; p < parts; p++) {
      uint8_t *mine = extent + 2 * (i * parts + p);
      mine[0] = mine[1] = 0;
      for (int64_t k = 0; k < width; k++)
        if (fabs(row[p * width + k]) > 1e-6) {
          if (!mine[1]) mine[0] = (uint8_t)k;
          mine[1] = (uint8_t)(k + 1);
        }
      for (int64_t o = 0; o < parts; o++)
        own[(i * parts + p) * parts + o] = dot(row + p * width, row + o * width, width);
    }
  }
}

/* One view of an end, in which apexes of one shape are tried, and what they have in common.

   The pictures show each part of the inside at distances before_mm + picture_mm * (0 ... s - 1) before the apex; before
   and beyond all is as in the outermost. sums (n + 1, each): over the rows from `first` on of what shows the shaft, which
   far from the apex all rows do, as many of them as were asked for so far.

   Of a whole row, whose weights are all 1, only what lies behind and the grey differ from pixel to pixel, varying
   (n, 2, width): the planes' sums are moments (distances, MOMENTS, parts) of the picture times powers of along (n,). */
typedef struct {
  const TipView *view;
  const double *arc_mm;
  int64_t n, width, each, first, summed;
  double picture_mm;
  Shape shape;
  int64_t s;
  double before_mm;
  double *sums, *varying, *along, *across, *moments;
  uint8_t *whole;
} Tried;

static int64_t row_of(const Tried *t, double at_mm, int64_t r) {
  return (int64_t)rint((at_mm - t->arc_mm[r] - t->before_mm) / t->picture_mm);
}

/* Takes apart what whole rows say: across (width,) is x of any of them. */
static void take_apart(Tried *t) {
  for (int64_t r = 0; r < t->n; r++) {
    const double *weight = t->view->weight + r * t->width, *weighted = t->view->weighted + r * t->width * KINDS;
    t->whole[r] = 1;
    for (int64_t k = 0; k < t->width; k++) t->whole[r] &= weight[k] == 1;
    if (!t->whole[r]) continue;
    t->along[r] = weighted[2];
    double *varying = t->varying + 2 * r * t->width;
    for (int64_t k = 0; k < t->width; k++) {
      t->across[k] = weighted[k * KINDS + 1];
      varying[k] = weighted[k * KINDS + 6], varying[t->width + k] = weighted[k * KINDS + 7];
    }
  }
}

static void take_moments(Tried *t) {
  int64_t parts = t->view->parts, stride = whole_lanes(parts);
  for (int64_t i = 0; i < t->s; i++)
    for (int64_t p = 0; p < parts; p++) {
      const double *picture = t->shape.pictures + (i * parts + p) * t->width;
      const uint8_t *extent = t->shape.extent + 2 * (i * parts + p);
      double sums[MOMENTS] = {0};
      for (int64_t k = extent[0]; k < extent[1]; k++) {
        double x = t->across[k];
        sums[0] += picture[k], sums[1] += picture[k] * x, sums[2] += picture[k] * x * x;
      }
      for (int j = 0; j < MOMENTS; j++) t->moments[(i * MOMENTS + j) * stride + p] = sums[j];
    }
}

/* Adds the planes' sums over whole rows, each of which shows a row `at` of the pictures, to mixed (parts, KINDS). */
static void add_planes(const Tried *t, const int64_t *rows, const int64_t *at, int64_t count, double *mixed) {
  int64_t parts = t->view->parts, stride = whole_lanes(parts);
  for (int64_t first = 0; first < parts; first += LANES) {
    Lanes sums[PLANES - 1] = {{0}};
    for (int64_t i = 0; i < count; i++) {
      const double *moments = t->moments + at[i] * MOMENTS * stride + first;
      Lanes once = *(const Lanes *)moments, by_x = *(const Lanes *)(moments + stride);
      double s = t->along[rows[i]];
      sums[0] += once, sums[1] += by_x, sums[2] += once * s, sums[3] += by_x * s;
      sums[4] += *(const Lanes *)(moments + 2 * stride), sums[5] += once * (s * s);
    }
    for (int64_t p = first; p < parts && p < first + LANES; p++)
      for (int q = 0; q < PLANES - 1; q++) mixed[p * KINDS + q] += sums[q][p - first];
  }
}

/* Adds the parts' products in rows `at` of the pictures to own (total,). */
static void add_products(const double *products, int64_t total, const int64_t *at, int64_t count, double *own) {
  int64_t k = 0;
  for (; k + 4 * LANES <= total; k += 4 * LANES) {
    Lanes sums[4] = {{0}};
    for (int64_t i = 0; i < count; i++)
      for (int q = 0; q < 4; q++) sums[q] += *(const Lanes *)(products + at[i] * total + k + LANES * q);
    for (int q = 0; q < 4; q++) *(Lanes *)(own + k + LANES * q) += sums[q];
  }
  for (int64_t i = 0; i < count; i++)
    for (int64_t j = k; j < total; j++) own[j] += products[at[i] * total + j];
}

/* Adds what rows (count,) say, each of which shows a row `at` of the pictures, to sums (each,); whole rows, which nearly
   all are, together. rows and at are used up. */
static void add_rows(const Tried *t, int64_t *rows, int64_t *at, int64_t count, double *sums) {
  int64_t parts = t->view->parts, whole = 0;
  double *mixed = sums, *own = sums + parts * KINDS;
  Lanes varying[2 * MOST];
  for (int64_t p = 0; p < 2 * parts; p++) varying[p] = (Lanes){0};
  for (int64_t i = 0; i < count; i++) {
    int64_t r = rows[i];
    if (!t->whole[r]) {
      add_row(&t->shape, at[i], parts, t->view->weighted + r * t->width * KINDS, t->view->weight + r * t->width,
              t->width, mixed, own);
      continue;
    }
    rows[whole] = r, at[whole] = at[i];
    const double *picture = t->shape.pictures + at[whole] * parts * t->width;
    const uint8_t *extent = t->shape.extent + 2 * at[whole++] * parts;
    for (int64_t p = 0; p < parts; p++)
      add_shown(picture + p * t->width, extent + 2 * p, t->varying + 2 * r * t->width, t->width, varying + 2 * p);
  }
  for (int64_t p = 0; p < parts; p++)
    for (int q = 0; q < 2; q++) {
      Lanes sum = varying[2 * p + q];
      mixed[p * KINDS + PLANES - 1 + q] += (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }
  add_planes(t, rows, at, whole, mixed);
  add_products(t->shape.own, parts * parts, at, whole, own);
}

/* Another shape is tried, whose apexes are not before lowest_mm. */
static void try_shape(Tried *t, int64_t shape, double lowest_mm) {
  t->shape = (Shape){t->view->pictures[shape], t->view->own[shape], t->view->extent[shape]};
  t->s = t->view->distances[shape], t->before_mm = t->view->before_mm[shape];
  take_moments(t);
  memset(t->sums, 0, (size_t)t->each * sizeof *t->sums);
  int64_t rows[t->n], at[t->n];
  t->first = 0;
  while (t->first < t->n && row_of(t, lowest_mm, t->first) >= t->s - 1)
    rows[t->first] = t->first, at[t->first++] = t->s - 1;
  add_rows(t, rows, at, t->first, t->sums);
  t->summed = t->first;
}

/* The sums over all rows of the shaft for an apex, and how many they are. */
static const double *shaft_of(Tried *t, double at_mm, int64_t *rows, double *none) {
  int64_t r = 0;
  while (r < t->n && row_of(t, at_mm, r) >= t->s - 1) r++;
  *rows = r;
  if (r < t->first) {
    /* Before all that were foreseen: of no needle at all. */
    *rows = 0;
    memset(none, 0, (size_t)t->each * sizeof *none);
    return none;
  }
  for (; t->summed < r; t->summed++) {
    double *sums = t->sums + (t->summed + 1 - t->first) * t->each;
    int64_t row = t->summed, at = t->s - 1;
    memcpy(sums, sums - t->each, (size_t)t->each * sizeof *sums);
    add_rows(t, &row, &at, 1, sums);
  }
  return t->sums + (r - t->first) * t->each;
}

/* What all rows say of an apex, (each,): see `Shape`. */
static void sums_of(Tried *t, double at_mm, double *sums) {
  int64_t r, count = 0, rows[t->n], at[t->n];
  const double *shaft = shaft_of(t, at_mm, &r, sums);
  if (shaft != sums) memcpy(sums, shaft, (size_t)t->each * sizeof *sums);
  for (; r < t->n; r++) {
    int64_t row = row_of(t, at_mm, r);
    if (row < 0) break; /* Nothing of it shows from here on. */
    rows[count] = r, at[count++] = row < t->s ? row : t->s - 1;
  }
  add_rows(t, rows, at, count, sums);
}

/* The lower triangle (size + 1, size + 1) of one lane's normal matrix of planes and parts, bordered by their products
   with the grey and the grey's own. */
static void bordered(const double *fixed, const double *sums, int64_t parts, const double *prior, int64_t lane,
                     double *normal) {
  int64_t size = PLANES + parts, row = (size + 1) * LANES;
  const double *own = sums + parts * KINDS;
  double *border = normal + size * row + lane;
  for (int64_t i = 0; i < PLANES; i++) {
    for (int64_t j = 0; j <= i; j++) normal[i * row + j * LANES + lane] = fixed[i * KINDS + j] + prior[i * size + j];
    border[i * LANES] = fixed[i * KINDS + PLANES];
  }
  for (int64_t p = 0; p < parts; p++) {
    double *mine = normal + (PLANES + p) * row + lane;
    const double *mixed = sums + p * KINDS, *known = prior + (PLANES + p) * size;
    for (int64_t j = 0; j < PLANES; j++) mine[j * LANES] = mixed[j] + known[j];
    for (int64_t o = 0; o <= p; o++) mine[(PLANES + o) * LANES] = own[p * parts + o] + known[PLANES + o];
    border[(PLANES + p) * LANES] = mixed[PLANES];
  }
  border[size * LANES] = fixed[PLANES * KINDS + PLANES];
}

/* Eliminates all but the border of as many matrices (size + 1, size + 1) as there are lanes (Cholesky): what is left of
   its diagonal is the squared grey left over. log_determinant (LANES,). Returns 1 where one is not positive definite. */
static int eliminated(Lanes *normal, int64_t size, double *log_determinant) {
  Lanes column[PLANES + MOST + 1], determinant = (Lanes){0} + 1;
  for (int l = 0; l < LANES; l++) log_determinant[l] = 0;
  for (int64_t j = 0; j < size; j++) {
    Lanes pivot = normal[j * (size + 1) + j], over = 1 / pivot;
    determinant *= pivot;
    for (int l = 0; l < LANES; l++) {
      if (!(pivot[l] > 0)) return 1;
      if (determinant[l] > 1e200 || determinant[l] < 1e-200)
        log_determinant[l] += log(determinant[l]), determinant[l] = 1;
    }
    for (int64_t i = j + 1; i <= size; i++) {
      Lanes *mine = normal + i * (size + 1);
      column[i] = mine[j];
      Lanes share = mine[j] * over;
      for (int64_t k = j + 1; k <= i; k++) mine[k] -= share * column[k];
    }
  }
  for (int l = 0; l < LANES; l++) log_determinant[l] += log(determinant[l]);
  return 0;
}

/* For apexes at_mm (apexes,): squared greys left over, and the log determinant of what the parts could show.

   prior: (7 + parts,)^2. Returns 1 where it fails. */
static int misfits(Tried *t, const double *at_mm, int64_t apexes, const double *prior, double *out) {
  int64_t parts = t->view->parts, size = PLANES + parts;
  Lanes normal[(size + 1) * (size + 1)];
  double sums[t->each], log_determinant[LANES];
  for (int64_t first = 0; first < apexes; first += LANES) {
    for (int64_t l = 0; l < LANES; l++) {
      /* Lanes for which there is no apex are as the last that has one. */
      if (first + l < apexes) sums_of(t, at_mm[first + l], sums);
      bordered(t->view->fixed, sums, parts, prior, l, (double *)normal);
    }
    if (eliminated(normal, size, log_determinant)) return 1;
    for (int64_t l = 0; l < LANES && first + l < apexes; l++) {
      out[2 * (first + l)] = normal[size * (size + 1) + size][l];
      out[2 * (first + l) + 1] = log_determinant[l];
    }
  }
  return 0;
}

static int64_t mirrored(int64_t at, int64_t length) {
  while (at < 0 || at >= length) at = at < 0 ? -at - 1 : 2 * length - 1 - at;
  return at;
}

/* The sum (width,) of rows `taps` (count,), weighted; a few columns at a time, whose sums stay in registers. */
static void weighed(const double *const *taps, const double *weights, int64_t count, int64_t width, double *out) {
  int64_t j = 0;
  for (; j + 4 * LANES <= width; j += 4 * LANES) {
    Lanes sums[4] = {{0}};
    for (int64_t k = 0; k < count; k++)
      for (int q = 0; q < 4; q++) sums[q] += weights[k] * *(const Lanes *)(taps[k] + j + LANES * q);
    for (int q = 0; q < 4; q++) *(Lanes *)(out + j + LANES * q) = sums[q];
  }
  for (; j + LANES <= width; j += LANES) {
    Lanes sum = {0};
    for (int64_t k = 0; k < count; k++) sum += weights[k] * *(const Lanes *)(taps[k] + j);
    *(Lanes *)(out + j) = sum;
  }
  for (; j < width; j++) {
    out[j] = 0;
    for (int64_t k = 0; k < count; k++) out[j] += weights[k] * taps[k][j];
  }
}

/* Gaussian blur (n, width), mirrored at the borders as SciPy's `reflect`, to four sigmas. */
static void blurred(const double *in, int64_t n, int64_t width, const double *sigma, double *out, double *work) {
  double padded[width + 62];
  for (int axis = 0; axis < 2; axis++) {
    const double *from = axis ? work : in, *taps[63];
    double *to = axis ? out : work, kernel[63], sum = 0;
    int64_t radius = (int64_t)(4 * sigma[axis] + 0.5), count;
    radius = radius > 31 ? 31 : radius, count = 2 * radius + 1;
    for (int64_t k = 0; k < count; k++)
      sum += kernel[k] = exp(-0.5 * (double)((k - radius) * (k - radius)) / (sigma[axis] * sigma[axis]));
    for (int64_t k = 0; k < count; k++) kernel[k] /= sum;
    for (int64_t i = 0; i < n; i++) {
      if (axis)
        for (int64_t j = -radius; j < width + radius; j++) padded[j + radius] = from[i * width + mirrored(j, width)];
      for (int64_t k = 0; k < count; k++) taps[k] = axis ? padded + k : from + mirrored(i + k - radius, n) * width;
      weighed(taps, kernel, count, width, to + i * width);
    }
  }
}

/* The mean of both rims of a picture (n, width): the background's level, whatever the needle's is. */
static double beside_of(const double *picture, int64_t n, int64_t width) {
  double sum = 0;
  for (int64_t i = 0; i < n; i++) sum += picture[i * width] + picture[(i + 1) * width - 1];
  return sum / (double)(2 * n);
}

static double median_of(const double *v, int64_t n, double *work) {
  float *copy = (float *)work;
  for (int64_t i = 0; i < n; i++) copy[i] = (float)v[i];
  double high = selected(copy, n, n / 2);
  return n % 2 ? high : (high + selected(copy, n, n / 2 - 1)) / 2;
}

/* Adds to the lower triangle of fixed (8, 8) the products of one row's kinds, weighted: along a row s is the same, so of
   the planes only the powers of x (width,) are to be summed. behind, gray (width,). */
static void add_fixed(const double *x, double s, const double *behind, const double *gray, const double *weight,
                      int64_t width, double *fixed) {
  static const int in_x[PLANES - 1] = {0, 1, 0, 1, 2, 0}, in_s[PLANES - 1] = {0, 0, 1, 1, 0, 2};
  double powers[5] = {0}, by_behind[3] = {0}, by_gray[3] = {0}, both = 0, twice = 0, grays = 0;
  for (int64_t k = 0; k < width; k++) {
    double w = weight[k], one = w * x[k], two = one * x[k], three = two * x[k], b = behind[k], g = gray[k];
    powers[0] += w, powers[1] += one, powers[2] += two, powers[3] += three, powers[4] += three * x[k];
    by_behind[0] += w * b, by_behind[1] += one * b, by_behind[2] += two * b;
    by_gray[0] += w * g, by_gray[1] += one * g, by_gray[2] += two * g;
    twice += w * b * b, both += w * b * g, grays += w * g * g;
  }
  const double of_s[5] = {1, s, s * s, s * s * s, s * s * s * s};
  for (int p = 0; p < PLANES - 1; p++) {
    for (int q = 0; q <= p; q++) fixed[p * KINDS + q] += of_s[in_s[p] + in_s[q]] * powers[in_x[p] + in_x[q]];
    fixed[(PLANES - 1) * KINDS + p] += of_s[in_s[p]] * by_behind[in_x[p]];
    fixed[PLANES * KINDS + p] += of_s[in_s[p]] * by_gray[in_x[p]];
  }
  fixed[(PLANES - 1) * KINDS + PLANES - 1] += twice;
  fixed[PLANES * KINDS + PLANES - 1] += both, fixed[PLANES * KINDS + PLANES] += grays;
}

/* One view straightened past an end, of rows local_mm (n, 3) in the camera's frame at arc_mm (n,), across (width,).

   See `tip._look`: gray, weight (n, width), weighted (n, width, 8), fixed (8, 8), noise_gray; returns the median sine
   of the angle to the line of sight. reach: how far the needle reaches to either side, units. rules = (saturated grey,
   margin px, most lag, price of lag, least noise, sigma along, sigma across). work: room for 4 n width + 16 n. */
EXPORT double tip_picture(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *c,
                          const double *local_mm, const double *arc_mm, int64_t n, const double *across, int64_t width,
                          double unit_mm, double reach, const double *rules, double *gray, double *weight,
                          double *weighted, double *fixed, double *noise_gray, double *work) {
  int64_t plane = n * width;
  double *px = work, *normal = px + 2 * n, *toward = normal + 2 * n, *one = toward + n, *other = one + n,
         *spare = other + n, *share = spare + n;
  double *smooth = work + 16 * n;
  float *strip = (float *)(smooth + plane);
  straighten(image, rows, columns, stride, c, local_mm, n, across, width, unit_mm, px, normal, strip);
  double level = noise(strip, n, width, (float *)(smooth + 2 * plane));
  *noise_gray = level > rules[4] ? level : rules[4];
  for (int64_t i = 0; i < n; i++) {
    const double *p = local_mm + 3 * i, *a = local_mm + 3 * (i > 0 ? i - 1 : 0),
                 *b = local_mm + 3 * (i + 1 < n ? i + 1 : n - 1);
    double along[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
    double length = sqrt(dot(along, along, 3) * dot(p, p, 3));
    toward[i] = fabs(dot(along, p, 3)) / (length > 1e-300 ? length : 1e-300);
    int inside = px[2 * i] >= rules[1] && px[2 * i + 1] >= rules[1] &&
                 px[2 * i] <= (double)columns - 1 - rules[1] && px[2 * i + 1] <= (double)rows - 1 - rules[1];
    for (int64_t k = 0; k < width; k++) {
      double g = strip[i * width + k];
      gray[i * width + k] = g;
      weight[i * width + k] = inside && g < rules[0];
    }
  }
  double middle = median_of(toward, n, spare), sine = 1 - middle * middle;
  sine = sqrt(sine > 0 ? sine : 0);
  /* What is behind: as it is beside. */
  blurred(gray, n, width, rules + 5, smooth, smooth + plane);
  double last = across[width - 1], beyond = reach < last - 0.75 ? reach : last - 0.75;
  int64_t left = 0, right = width - 1;
  for (int64_t k = 0; k < width; k++)
    if (fabs(across[k]) > beyond) {
      if (across[k] < 0) left = k;
      else if (k < right) right = k;
    }
  for (int64_t k = 0; k < width && k < 11 * n; k++) {
    double t = (across[k] - across[left]) / (across[right] - across[left]);
    share[k] = t < 0 ? 0 : t > 1 ? 1 : t;
  }
  for (int64_t i = 0; i < n; i++) one[i] = smooth[i * width + left], other[i] = smooth[i * width + right];
  filled(smooth, n, width, left, right, best_lag(one, other, n, (int64_t)rules[2], rules[3]), share, one, other);
  double behind = beside_of(smooth, n, width), all = beside_of(gray, n, width);
  double mean = 0;
  for (int64_t i = 0; i < n; i++) mean += arc_mm[i] / (double)n;
  double half = (arc_mm[n - 1] - arc_mm[0]) / 2;
  memset(fixed, 0, KINDS * KINDS * sizeof *fixed);
  double *shown = smooth + plane, *far = shown + plane;
  for (int64_t k = 0; k < width; k++) far[k] = across[k] / last;
  for (int64_t i = 0; i < n; i++) {
    double s = (arc_mm[i] - mean) / half, *darker = smooth + i * width;
    for (int64_t k = 0; k < width; k++) {
      int64_t at = i * width + k;
      double x = far[k], w = weight[at];
      darker[k] -= behind, shown[k] = gray[at] - all;
      double v[KINDS] = {1, x, s, x * s, x * x, s * s, darker[k], shown[k]};
      for (int p = 0; p < KINDS; p++) weighted[KINDS * at + p] = w * v[p];
    }
    add_fixed(far, s, darker, shown, weight + i * width, width, fixed);
  }
  for (int p = 0; p < KINDS; p++)
    for (int q = 0; q < p; q++) fixed[q * KINDS + p] = fixed[p * KINDS + q];
  return sine;
}

/* Where the parabola through the lowest of evenly spaced values and its neighbours is lowest. */
static double lowest(const double *at, const double *cost, int64_t n) {
  int64_t i = 0;
  for (int64_t k = 1; k < n; k++) i = cost[k] < cost[i] ? k : i;
  i = i < 1 ? 1 : i > n - 2 ? n - 2 : i;
  double bend = cost[i - 1] - 2 * cost[i] + cost[i + 1], shift = 0;
  if (bend > 0) shift = (cost[i - 1] - cost[i + 1]) / (2 * bend);
  shift = shift < -1 ? -1 : shift > 1 ? 1 : shift;
  return at[i] + shift * (at[1] - at[0]);
}

/* Standard deviation of the place whose negative log likelihoods these are. */
static double width_of(const double *at, const double *cost, int64_t n) {
  double least = INFINITY, sum = 0, mean = 0, square = 0;
  for (int64_t k = 0; k < n; k++) least = cost[k] < least ? cost[k] : least;
  for (int64_t k = 0; k < n; k++) {
    double w = exp(least - cost[k]);
    sum += w, mean += w * at[k];
  }
  mean /= sum;
  for (int64_t k = 0; k < n; k++) square += exp(least - cost[k]) * (at[k] - mean) * (at[k] - mean);
  return sqrt(square / sum);
}

/* Negative log evidence (t,) of an apex from that of each view (2, t), which may be a little off each other. */
static void together(const double *at, const double *cost, int64_t t, double sigma, double *out) {
  for (int64_t i = 0; i < t; i++) out[i] = 0;
  for (int v = 0; v < 2; v++)
    for (int64_t i = 0; i < t; i++) {
      double least = INFINITY;
      for (int64_t k = 0; k < t; k++) {
        double off = (at[i] - at[k]) / sigma, value = cost[v * t + k] + 0.5 * off * off;
        least = value < least ? value : least;
      }
      out[i] += least;
    }
}

#define MOST_SHAPES 8
#define MOST_PLACES 64

/* The apex on rows at arc_mm (n,) about end_mm: see `tip.find_tip`.

   rules = (first and last apex tried from end_mm, coarse and fine step, how far the fine one reaches, what neighbouring
   samples share, sigma between the views, least noise, where the end was expected from end_mm and its sigma, least
   sigma, log evidence that makes a rival). prior, log_prior: of the background's and inside's parts, grey^-2.
   out = (at_mm, each_mm (2,), sigma_mm (2,), contrast (2,), the shape's number). work: room for
   2 ((n + 1) * 19 * 16 + n) + 2 * (7 + 16)^2. Returns 1 where the picture shows nothing. */
EXPORT int find_tip(const TipView *views, int64_t shapes, const double *arc_mm, int64_t n, int64_t width,
                    double picture_mm, const double *prior, double log_prior, double end_mm, const double *rules,
                    double *out, double *work) {
  double coarse[MOST_PLACES], near[MOST_SHAPES][MOST_PLACES], found[MOST_SHAPES][2][2 * MOST_PLACES];
  double cost[MOST_SHAPES][2 * MOST_PLACES], both[MOST_SHAPES][MOST_PLACES], scale[2] = {INFINITY, INFINITY},
         samples[2] = {0, 0}, rough[2][2 * MOST_PLACES];
  int64_t tries = (int64_t)floor((rules[1] + rules[2] / 2 - rules[0]) / rules[2]) + 1,
          fine = 2 * (int64_t)floor(rules[4] / rules[3] + 0.5) + 1;
  if (tries > MOST_PLACES || fine > MOST_PLACES || shapes > MOST_SHAPES) return 1;
  for (int64_t k = 0; k < tries; k++) coarse[k] = end_mm + rules[0] + rules[2] * (double)k;
  int64_t distances = 0;
  for (int v = 0; v < 2; v++)
    for (int64_t k = 0; k < shapes; k++)
      distances = views[v].distances[k] > distances ? views[v].distances[k] : distances;
  double varying[2][2 * n * width], along[2][n], across[2][width];
  double moments[2][distances * MOMENTS * whole_lanes(views[0].parts)], *scaled[2], log_priors[2];
  memset(across, 0, sizeof across);
  memset(moments, 0, sizeof moments);
  Tried tried[2];
  for (int v = 0; v < 2; v++) {
    int64_t size = PLANES + views[v].parts;
    double unit = views[v].noise_gray * views[v].noise_gray * rules[5];
    scaled[v] = work + v * size * size;
    for (int64_t k = 0; k < size * size; k++) scaled[v][k] = prior[k] * unit;
    log_priors[v] = log_prior + (double)size * log(unit);
    for (int64_t k = 0; k < n * width; k++) samples[v] += views[v].weight[k];
    samples[v] = samples[v] > 1 ? samples[v] : 1;
  }
  work += 2 * (PLANES + views[0].parts) * (PLANES + views[0].parts);
  for (int v = 0; v < 2; v++) {
    Tried *t = tried + v;
    int64_t each = views[v].parts * (KINDS + views[v].parts);
    *t = (Tried){.view = views + v, .arc_mm = arc_mm, .n = n, .width = width, .each = each, .picture_mm = picture_mm};
    t->sums = work, work += (n + 1) * each;
    t->whole = (uint8_t *)work, work += n / 8 + 1;
    t->varying = varying[v], t->along = along[v], t->across = across[v], t->moments = moments[v];
    take_apart(t);
  }
  double foreseen = end_mm + rules[8];
  for (int64_t shape = 0; shape < shapes; shape++) {
    for (int v = 0; v < 2; v++) try_shape(tried + v, shape, coarse[0] - rules[4]);
    for (int pass = 0; pass < 2; pass++) {
      int64_t count = pass ? fine : tries;
      const double *at = pass ? near[shape] : coarse;
      for (int v = 0; v < 2; v++) {
        double *into = pass ? found[shape][v] : rough[v];
        if (misfits(tried + v, at, count, scaled[v], into)) return 1;
        for (int64_t k = 0; k < count; k++) into[2 * k + 1] -= log_priors[v];
        double least = INFINITY;
        for (int64_t k = 0; k < count; k++) least = into[2 * k] < least ? into[2 * k] : least;
        if (pass) {
          /* The scale of what is left over is each view's own: that of its best fit. */
          scale[v] = least / samples[v] < scale[v] ? least / samples[v] : scale[v];
          continue;
        }
        double unit = least / samples[v];
        unit = unit > rules[7] * rules[7] ? unit : rules[7] * rules[7];
        for (int64_t k = 0; k < count; k++)
          cost[shape][v * count + k] = into[2 * k] / unit / 2 / rules[5] + into[2 * k + 1] / 2;
      }
      if (pass) continue;
      together(coarse, cost[shape], tries, rules[6], both[shape]);
      int64_t best = 0;
      double least = INFINITY;
      for (int64_t k = 0; k < tries; k++) {
        double off = (coarse[k] - foreseen) / rules[9], value = both[shape][k] + 0.5 * off * off;
        /* Each view may prefer a neighbour of its own: then both are as good, and rounding has no say. */
        if (value < least - 1e-9) least = value, best = k;
      }
      for (int64_t k = 0; k < fine; k++)
        near[shape][k] = coarse[best] + rules[3] * ((double)k - (double)(fine - 1) / 2);
    }
  }
  int64_t chosen = 0;
  double least[MOST_SHAPES];
  for (int v = 0; v < 2; v++) {
    double quiet = views[v].noise_gray * views[v].noise_gray;
    scale[v] = scale[v] > quiet ? scale[v] : quiet;
  }
  for (int64_t shape = 0; shape < shapes; shape++) {
    for (int v = 0; v < 2; v++)
      for (int64_t k = 0; k < fine; k++)
        cost[shape][v * fine + k] =
            found[shape][v][2 * k] / scale[v] / 2 / rules[5] + found[shape][v][2 * k + 1] / 2;
    together(near[shape], cost[shape], fine, rules[6], both[shape]);
    least[shape] = INFINITY;
    for (int64_t k = 0; k < fine; k++) {
      double off = (near[shape][k] - foreseen) / rules[9];
      both[shape][k] += 0.5 * off * off;
      least[shape] = both[shape][k] < least[shape] ? both[shape][k] : least[shape];
    }
    if (least[shape] < least[chosen]) chosen = shape;
  }
  out[0] = lowest(near[chosen], both[chosen], fine);
  for (int v = 0; v < 2; v++) {
    out[1 + v] = lowest(near[chosen], cost[chosen] + v * fine, fine);
    double sigma = width_of(near[chosen], cost[chosen] + v * fine, fine);
    out[3 + v] = sigma > rules[10] ? sigma : rules[10];
    /* Of a needle that goes on, and of none. */
    double ends[2] = {arc_mm[n - 1] + 4, arc_mm[0] - 2}, others[4], best = INFINITY;
    if (shapes > 1) try_shape(tried + v, chosen, coarse[0] - rules[4]);
    if (misfits(tried + v, ends, 2, scaled[v], others)) return 1;
    for (int64_t k = 0; k < fine; k++) best = found[chosen][v][2 * k] < best ? found[chosen][v][2 * k] : best;
    double better = ((others[0] < others[2] ? others[0] : others[2]) - best) / scale[v] / rules[5];
    out[5 + v] = sqrt(better > 0 ? better : 0);
  }
  /* Another shape of end that explains the pictures nearly as well would put the apex elsewhere. */
  for (int64_t shape = 0; shape < shapes; shape++)
    if (shape != chosen && least[shape] - least[chosen] < rules[11]) {
      double off = (lowest(near[shape], both[shape], fine) - out[0]) / 2;
      for (int v = 0; v < 2; v++) out[3 + v] = sqrt(out[3 + v] * out[3 + v] + off * off);
    }
  out[7] = (double)chosen;
  return 0;
}
