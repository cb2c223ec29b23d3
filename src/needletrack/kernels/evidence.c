/* From cross sections to where the axis is: the log evidence of `tracking/evidence.py` and what is read from it. */
#include "kernels.h"

#define MOST_SAMPLES 64
/* Shifts to either side that are asked for at most, and finer ones. */
#define MOST_PLACES 64
#define MOST_FINE 512
/* Places that sixteen finer shifts ask, where there are four of these or more to a place. */
#define MOST_NEAR 32

/* Sections are told in samples that are even and odd about their middle: (y_k + y_-k) and (y_k - y_-k), over the root of
   two, the middle one as it is. What treats left and right alike then mixes none of the one with any of the other. */
int64_t even_samples(int64_t count) { return (count + 1) / 2; }
int64_t even_features(int64_t count) {
  int64_t even = even_samples(count), odd = count - even;
  return even * (even + 1) / 2 + odd * (odd + 1) / 2 + 1;
}
int64_t features(int64_t count) { return count * (count + 1) / 2 + 1; }

/* The median of (count,): that of which as many are less as are more. Counting is vectors; sorting is not. */
static double middle_of_samples(const double *v, int64_t count) {
  float values[MOST_SAMPLES];
  int32_t below[MOST_SAMPLES] = {0};
  for (int64_t k = 0; k < count; k++) values[k] = (float)v[k];
  for (int64_t j = 0; j < count; j++) {
    float other = values[j];
    for (int64_t k = 0; k < j; k++) below[k] += other < values[k];
    for (int64_t k = j; k < count; k++) below[k] += other <= values[k];
  }
  double low = 0, high = 0;
  for (int64_t k = 0; k < count; k++) {
    /* Each is not more than itself, nor equal ones before it. */
    if (below[k] - 1 == (count - 1) / 2) low = v[k];
    if (below[k] - 1 == count / 2) high = v[k];
  }
  return (low + high) / 2;
}

/* The products (n, f) of every two samples, whitened, even and odd, of sections (n, count), and 1.

   First those that stay as they are where left and right change places (of two even ones, of two odd ones, and 1), then
   those that change their sign. whitener: (count, count), to even samples and then to odd ones. */
EXPORT void products(const double *sections, int64_t n, int64_t count, const double *whitener, float *out) {
  int64_t even = even_samples(count);
  float columns[MOST_SAMPLES * MOST_SAMPLES];
  for (int64_t j = 0; j < count; j++)
    for (int64_t k = 0; k < count; k++) columns[j * count + k] = (float)whitener[k * count + j];
  for (int64_t i = 0; i < n; i++) {
    const double *section = sections + i * count;
    float centered[MOST_SAMPLES], white[MOST_SAMPLES] = {0}, *at = out + i * features(count);
    double median = middle_of_samples(section, count);
    for (int64_t k = 0; k < count; k++) centered[k] = (float)(section[k] - median);
    for (int64_t j = 0; j < count; j++)
      for (int64_t k = 0; k < count; k++) white[k] += columns[j * count + k] * centered[j];
    for (int64_t k = 0; k < even; at += even - k++)
      for (int64_t j = k; j < even; j++) at[j - k] = white[k] * white[j];
    for (int64_t k = even; k < count; at += count - k++)
      for (int64_t j = k; j < count; j++) at[j - k] = white[k] * white[j];
    *at++ = 1;
    for (int64_t k = 0; k < even; k++, at += count - even)
      for (int64_t j = even; j < count; j++) at[j - even] = white[k] * white[j];
  }
}

/* Columns of a bank of p shifts: eight of them before one kind of background, the same before the other, the next. */
int64_t columns_of(int64_t p) { return (p + 7) / 8 * 16; }

/* A bank of covariances (2, places, count, count) of what is seen but for the noise, before one kind of background and
   before the other: the weights of `products` in the log evidence -1/2 x' C^-1 x - 1/2 log det C of sections x.

   unwhitened (count, count): rows of the inverse of what `products` whitens by. C = R' R by Cholesky; with M the solution
   of R' M = unwhitened the inverse, whitened, is M' M. out: panels as `both_ways` reads them, filled up with zeros. */
EXPORT void evidence_bank(const double *covariances, int64_t places, int64_t count, const double *unwhitened,
                          float *out) {
  double root[MOST_SAMPLES * MOST_SAMPLES], solved[MOST_SAMPLES * MOST_SAMPLES], inverse[MOST_SAMPLES * MOST_SAMPLES];
  const int64_t even = even_samples(count), of_even = even_features(count), of_odd = features(count) - of_even;
  const size_t square = sizeof(double) * (size_t)(count * count);
  float *odd = out + columns_of(places) * of_even;
  memset(out, 0, sizeof(float) * (size_t)(columns_of(places) * features(count)));
  for (int64_t each = 0; each < 2 * places; each++) {
    memcpy(root, covariances + each * count * count, square);
    memcpy(solved, unwhitened, square);
    memset(inverse, 0, square);
    double log_determinant = 0;
    for (int64_t k = 0; k < count; k++) {
      double *row = root + k * count, *there = solved + k * count;
      double pivot = sqrt(row[k] + 1), scale = 1 / pivot;
      log_determinant += log(pivot);
      for (int64_t j = k + 1; j < count; j++) row[j] *= scale;
      for (int64_t j = 0; j < count; j++) there[j] *= scale;
      for (int64_t i = k + 1; i < count; i++) {
        double factor = row[i], *below = root + i * count, *next = solved + i * count;
        for (int64_t j = i; j < count; j++) below[j] -= factor * row[j];
        for (int64_t j = 0; j < count; j++) next[j] -= factor * there[j];
      }
      for (int64_t i = 0; i < count; i++) {
        double factor = there[i], *sum = inverse + i * count;
        for (int64_t j = i; j < count; j++) sum[j] += factor * there[j];
      }
    }
    int64_t place = each % places, column = each / places * 8 + place % 8;
    float *at = out + place / 8 * 16 * of_even + column;
    for (int64_t i = 0; i < count; i++)
      for (int64_t j = i, last = i < even ? even : count; j < last; j++, at += 16)
        *at = (float)((i == j ? -0.5 : -1) * inverse[i * count + j]);
    *at = (float)-log_determinant;
    at = odd + place / 8 * 16 * of_odd + column;
    for (int64_t i = 0; i < even; i++)
      for (int64_t j = even; j < count; j++, at += 16) *at = (float)-inverse[i * count + j];
  }
}

#ifdef __AVX__
#define LANES 8
#else
#define LANES 4
#endif
typedef float Lanes __attribute__((vector_size(4 * LANES)));

/* `high` rows (a constant, so that all sums stay in registers) and the sixteen columns of a panel of a product. */
static inline __attribute__((always_inline)) void tile(int high, const float *a, int64_t stride, int64_t k,
                                                       const float *panel, float (*out)[16]) {
  for (int half = 0; half < 16; half += 2 * LANES) {
    Lanes sum[6][2], one, two;
    for (int r = 0; r < high; r++) sum[r][0] = sum[r][1] = (Lanes){0};
    for (int64_t i = 0; i < k; i++) {
      memcpy(&one, panel + 16 * i + half, sizeof one);
      memcpy(&two, panel + 16 * i + half + LANES, sizeof two);
      for (int r = 0; r < high; r++) {
        float left = a[r * stride + i];
        sum[r][0] += left * one, sum[r][1] += left * two;
      }
    }
    for (int r = 0; r < high; r++) {
      memcpy(out[r] + half, &sum[r][0], sizeof one);
      memcpy(out[r] + half + LANES, &sum[r][1], sizeof two);
    }
  }
}

/* out (n, c) = a (n, k) b (k, c), six rows and sixteen columns at a time; rows of a are `stride` apart, rows of out
   `out_stride`; b in panels (c / 16, k, 16), filled up. */
static void multiply(const float *a, int64_t n, int64_t stride, int64_t k, const float *panels, int64_t c, float *out,
                     int64_t out_stride) {
  for (int64_t column = 0; column < c; column += 16, panels += 16 * k) {
    int64_t wide = c - column < 16 ? c - column : 16;
    for (int64_t row = 0; row < n; row += 6) {
      const float *left = a + row * stride;
      float sums[6][16];
      int64_t high = n - row < 6 ? n - row : 6;
      switch (high) {
        case 1: tile(1, left, stride, k, panels, sums); break;
        case 2: tile(2, left, stride, k, panels, sums); break;
        case 3: tile(3, left, stride, k, panels, sums); break;
        case 4: tile(4, left, stride, k, panels, sums); break;
        case 5: tile(5, left, stride, k, panels, sums); break;
        default: tile(6, left, stride, k, panels, sums);
      }
      for (int64_t r = 0; r < high; r++)
        memcpy(out + (row + r) * out_stride + column, sums[r], (size_t)wide * sizeof(float));
    }
  }
}

/* Log evidence (n, c) of what the first c columns of a bank hold, and of its mirror images, for `products` (n, f) of
   sections of `count`.

   bank: of `all` columns, in panels, the rows of even products and then those of odd ones. work: (2, n, c). */
static void both_ways(const float *shown, int64_t n, int64_t count, const float *bank, int64_t all, int64_t c,
                      float *ahead, float *mirrored, float *work) {
  int64_t even = even_features(count), every = features(count);
  float *one = work, *other = work + n * c;
  multiply(shown, n, every, even, bank, c, one, c);
  multiply(shown + even, n, every, every - even, bank + even * all, c, other, c);
  for (int64_t k = 0; k < n * c; k++) ahead[k] = one[k] + other[k], mirrored[k] = one[k] - other[k];
}

/* Log evidence (n, 2 (2 p - 1)) of the axis at each shift, first before one kind of background, then before the other.

   bank: of shifts 0 .. places - 1 of either kind, of which the first p are asked. work: (4, n, columns_of(p)). */
EXPORT void by_background(const float *shown, int64_t n, int64_t count, const float *bank, int64_t places, int64_t p,
                          float *out, float *work) {
  int64_t c = columns_of(p), s = 2 * p - 1;
  float *ahead = work, *mirrored = ahead + n * c;
  both_ways(shown, n, count, bank, columns_of(places), c, ahead, mirrored, mirrored + n * c);
  for (int64_t i = 0; i < n; i++)
    for (int64_t kind = 0; kind < 2; kind++) {
      const float *here = ahead + i * c + 8 * kind, *there = mirrored + i * c + 8 * kind;
      float *row = out + 2 * i * s + kind * s + p - 1;
      for (int64_t k = 0; k < p; k++) row[-k] = there[16 * (k / 8) + k % 8], row[k] = here[16 * (k / 8) + k % 8];
    }
}

/* Log evidence (n, s) of one or the other of two (n, s) each that lie in one array, row by row; see `either`. */
EXPORT void either_of_both(const float *both, int64_t n, int64_t s, float *out) {
  for (int64_t i = 0; i < n; i++) {
    const float *one = both + 2 * i * s, *other = one + s;
    for (int64_t k = 0; k < s; k++) {
      float more = one[k] > other[k] ? one[k] : other[k], apart = fabsf(one[k] - other[k]);
      out[i * s + k] = more + log_one_plus_exp_negative(apart);
    }
  }
}

/* Log evidence no section has. */
#define NOTHING -1e30f

/* The most of (n,): eight at a time, since a maximum that has to respect NaN is not made a vector by itself. */
static float most_of(const float *v, int64_t n) {
  float most[8], all = -INFINITY;
  int64_t k = 0;
  for (int j = 0; j < 8; j++) most[j] = -INFINITY;
  for (; k + 8 <= n; k += 8)
    for (int j = 0; j < 8; j++) most[j] = v[k + j] > most[j] ? v[k + j] : most[j];
  for (; k < n; k++) all = v[k] > all ? v[k] : all;
  for (int j = 0; j < 8; j++) all = most[j] > all ? most[j] : all;
  return all;
}

/* Log evidence (c / 2,) before one kind of background or the other, of columns (c,) of a bank. */
static void either_way(const float *columns, int64_t c, float *out) {
  for (int64_t panel = 0; panel < c; panel += 16, columns += 16, out += 8)
    for (int k = 0; k < 8; k++) {
      float even = columns[k], clutter = columns[8 + k], more = even > clutter ? even : clutter;
      out[k] = more + log_one_plus_exp_negative(fabsf(even - clutter));
    }
}

/* Log evidence (n,) of background alone, or of one edge between two, which may be anywhere.

   bank: of an edge at shifts 0 .. p - 1, and of background alone. work: (4, n, columns_of(p + 1)). */
EXPORT void no_needle(const float *shown, int64_t n, int64_t count, const float *bank, int64_t p, double *out,
                      float *work) {
  int64_t c = columns_of(p + 1), edges = 2 * p - 1, last = 16 * (p / 8) + p % 8;
  float *ahead = work, *mirrored = ahead + n * c;
  both_ways(shown, n, count, bank, c, c, ahead, mirrored, mirrored + n * c);
  for (int64_t i = 0; i < n; i++) {
    const float *one = ahead + i * c, *other = mirrored + i * c;
    float most = one[last] > one[last + 8] ? one[last] : one[last + 8];
    double alone = (double)most + log_one_plus_exp_negative(fabsf(one[last] - one[last + 8]));
    /* An edge in the middle is its own mirror image, and what fills the last panel up is nothing. */
    float any[2 * MOST_SAMPLES];
    int64_t all = c / 2;
    either_way(one, c, any), either_way(other, c, any + all);
    any[all] = NOTHING;
    for (int64_t k = p; k < all; k++) any[k] = any[all + k] = NOTHING;
    float likeliest = most_of(any, 2 * all), sum = 0;
    for (int64_t k = 0; k < 2 * all; k++) sum += exp_negative(any[k] - likeliest);
    double anywhere = (double)likeliest + log((double)sum / (double)edges);
    double larger = alone > anywhere ? alone : anywhere;
    out[i] = larger + log1p(exp(-fabs(alone - anywhere)));
  }
}

/* Log evidence (n, s) of a needle over none, and whether (n,) it is likelier before clutter. */
EXPORT void over_none(const float *both, const double *none, int64_t n, int64_t s, double *log, uint8_t *cluttered) {
  float either[2 * MOST_PLACES];
  for (int64_t i = 0; i < n; i++) {
    const float *even = both + 2 * i * s, *clutter = even + s;
    double *over = log + i * s, nothing = none[i];
    for (int64_t k = 0; k < s; k++) {
      float more = even[k] > clutter[k] ? even[k] : clutter[k];
      either[k] = more + log_one_plus_exp_negative(fabsf(even[k] - clutter[k]));
    }
    for (int64_t k = 0; k < s; k++) over[k] = (double)either[k] - nothing;
    cluttered[i] = most_of(clutter, s) > most_of(even, s);
  }
}

/* The evidence of each section, ready to be asked.

   log (n, s) -> most (n,), relative (n, s) over it, and likelihood (n, f) at finer shifts over its most, plus
   `outlier`. refine (f, s) interpolates; a section that knows nothing has `never`. */
EXPORT void prepared(const double *log, int64_t n, int64_t s, const float *refine, int64_t f, double never,
                     float outlier, double *most, float *relative, float *likelihood) {
  /* A spline's weights fall off by 0.27 from sample to sample: eight to either side are all. They are the same for every
     section: sixteen finer shifts ask the same twenty places. */
  float panel[16 * MOST_NEAR];
  for (int64_t i = 0; i < n; i++) {
    const double *row = log + i * s;
    double top = never;
    for (int64_t k = 0; k < s; k++) top = row[k] > top ? row[k] : top;
    most[i] = top;
    float *low = relative + i * s;
    for (int64_t k = 0; k < s; k++) {
      double off = row[k] - top;
      low[k] = (float)(off > never ? off : never);
    }
  }
  for (int64_t first_fine = 0; first_fine < f; first_fine += 16) {
    int64_t wide = f - first_fine < 16 ? f - first_fine : 16;
    int64_t first = first_fine * (s - 1) / (f - 1) - 7, last = (first_fine + wide - 1) * (s - 1) / (f - 1) + 9;
    first = first < 0 ? 0 : first, last = last > s ? s : last;
    for (int64_t k = first; k < last; k++)
      for (int64_t j = 0; j < 16; j++) panel[16 * (k - first) + j] = j < wide ? refine[(first_fine + j) * s + k] : 0;
    multiply(relative + first, n, s, last - first, panel, wide, likelihood + first_fine, f);
  }
  for (int64_t i = 0; i < n; i++) {
    float *mine = relative + i * s, *finer = likelihood + i * f;
    for (int64_t k = 0; k < s; k++) mine[k] = exp_negative(mine[k]);
    float highest = most_of(finer, f);
    for (int64_t j = 0; j < f; j++) finer[j] = exp_negative(finer[j] - highest) + outlier;
  }
}

/* Places [first, last) of `count` evenly spaced ones at which a Gaussian is at least 1e-10 of its most. */
static void bell(double expected, double spread, double low, double step, int64_t count, int64_t *first, int64_t *last) {
  double middle = (expected - low) / step, reach = 6.79 * spread / step;
  double from = ceil(middle - reach), to = floor(middle + reach) + 1;
  *first = from < 0 ? 0 : from > (double)(count - 1) ? count - 1 : (int64_t)from;
  *last = to > (double)count ? count : to < (double)(*first + 1) ? *first + 1 : (int64_t)to;
}

/* What each section contributes where the axis is expected, px: see `silhouette.AxisEvidence.offsets`.

   grid = (low, step, s) of the shifts, and (low, step, f) of the finer ones. least_gain, least_sigma, used and
   clutter_factor as named there; doubtful (n,): where the last applies. sigma is infinite where the section says
   nothing. offset_px and sigma_px may be null: the support alone is wanted. */
EXPORT void sites(const double *most, const float *relative, const float *likelihood, int64_t n, double low,
                  double step, int64_t s, double fine_step, int64_t f, const double *expected_px, double spread,
                  const double *px_per_unit, const uint8_t *inside, const uint8_t *doubtful, double least_gain,
                  double least_sigma, double used, double clutter_factor, double *offset_px, double *sigma_px,
                  double *support) {
  double reach = low + step * (double)(s - 1);
  for (int64_t i = 0; i < n; i++) {
    double scale = px_per_unit[i], expected = expected_px[i] / scale;
    int64_t first, last;
    support[i] = -INFINITY;
    if (offset_px) offset_px[i] = 0, sigma_px[i] = INFINITY;
    if (!(fabs(expected) < 1e6)) continue;
    /* In steps, and from the expectation on: what is summed up stays small. */
    bell(expected, spread, low, step, s, &first, &last);
    float from = (float)((low - expected) / step), narrow = (float)(-0.5 * step * step / (spread * spread));
    float sum = 0, norm = 0;
    const float *coarse = relative + i * s, *fine = likelihood + i * f;
    for (int64_t k = first; k < last; k++) {
      float off = from + (float)(int32_t)k, weight = exp_negative(narrow * off * off);
      sum += coarse[k] * weight, norm += weight;
    }
    double mean = sum / norm;
    if (inside[i] && fabs(expected) < reach) support[i] = most[i] + log(mean > 1e-300 ? mean : 1e-300);
    if (!offset_px || !(support[i] > used)) continue;
    bell(expected, spread, low, fine_step, f, &first, &last);
    from = (float)((low - expected) / fine_step), narrow = (float)(-0.5 * fine_step * fine_step / (spread * spread));
    float total = 0, moment = 0, square = 0;
    for (int64_t k = first; k < last; k++) {
      float off = from + (float)(int32_t)k, weight = fine[k] * exp_negative(narrow * off * off);
      total += weight, moment += weight * off, square += weight * off * off;
    }
    double aside = (double)moment / (double)total, middle = expected + fine_step * aside;
    double variance = fine_step * fine_step * ((double)square / (double)total - aside * aside);
    double least = least_sigma * least_sigma / 4;
    variance = variance > least ? variance : least;
    double prior = 1 / (spread * spread), precision = 1 / variance - prior;
    if (!(precision > least_gain * prior)) continue;
    offset_px[i] = (middle / variance - expected * prior) / precision * scale;
    sigma_px[i] = sqrt(1 / precision + least_sigma * least_sigma) * (doubtful[i] ? clutter_factor : 1) * scale;
  }
}

/* The path (n,) through (n, s) that is worth most where turning aside costs `price` per place (Viterbi 1967).

   worth is overwritten. */
EXPORT void best_path(double *worth, int64_t n, int64_t s, double price, int64_t *path) {
  for (int64_t i = 1; i < n; i++) {
    const double *before = worth + (i - 1) * s;
    double ahead[512];
    /* The dearest step is as long as the section is wide: a distance transform, there and back. */
    ahead[0] = before[0];
    for (int64_t k = 1; k < s; k++) {
      double carried = ahead[k - 1] - price;
      ahead[k] = before[k] > carried ? before[k] : carried;
    }
    for (int64_t k = s - 2; k >= 0; k--) {
      double carried = ahead[k + 1] - price;
      ahead[k] = ahead[k] > carried ? ahead[k] : carried;
    }
    for (int64_t k = 0; k < s; k++) worth[i * s + k] += ahead[k];
  }
  int64_t at = 0;
  for (int64_t k = 1; k < s; k++) at = worth[(n - 1) * s + k] > worth[(n - 1) * s + at] ? k : at;
  path[n - 1] = at;
  for (int64_t i = n - 1; i > 0; i--) {
    double most = -INFINITY;
    for (int64_t k = 0; k < s; k++) {
      double value = worth[(i - 1) * s + k] - price * fabs((double)(path[i] - k));
      if (value > most) most = value, at = k;
    }
    path[i - 1] = at;
  }
}

/* The likeliest motion of the whole curve: see `AxisEvidence.likeliest_motion_px`. log (n, s) over its most, floored. */
EXPORT void best_motion(const double *log, int64_t n, int64_t s, const double *drifts, int64_t d, double step,
                        double motion_price, double floor_log, double *shift) {
  double most = -INFINITY, worth[512];
  int64_t best_drift = 0, best_place = 0;
  for (int64_t j = 0; j < d; j++) {
    for (int64_t k = 0; k < s; k++) {
      double place = ((double)k - (double)(s - 1) / 2) * step;
      worth[k] = -motion_price * place * place;
    }
    for (int64_t i = 0; i < n; i++) {
      int64_t off = (int64_t)rint(drifts[j] * (-0.5 + (double)i / (double)(n - 1)) / step);
      const double *row = log + i * s;
      int64_t first = off < 0 ? -off : 0, last = off > 0 ? s - off : s;
      first = first > s ? s : first, last = last < first ? first : last;
      for (int64_t k = 0; k < first; k++) worth[k] += floor_log;
      for (int64_t k = first; k < last; k++) worth[k] += row[k + off];
      for (int64_t k = last; k < s; k++) worth[k] += floor_log;
    }
    for (int64_t k = 0; k < s; k++)
      if (worth[k] > most) most = worth[k], best_drift = j, best_place = k;
  }
  for (int64_t i = 0; i < n; i++) {
    int64_t off = (int64_t)rint(drifts[best_drift] * (-0.5 + (double)i / (double)(n - 1)) / step);
    shift[i] = (double)(best_place - (s - 1) / 2 + off) * step;
  }
}
