/* A needle so bright that the picture saturates: see `tracking/clipped.py`. */
#include "curve.h"

enum { NOT_CLIPPED = OTHERS, NOT_SETTLED };

/* What the model takes for granted and how it is solved; as `clipped._Rules` lays it out, and explains. */
typedef struct {
  double clipped_gray, rim_px, deep_px, clipped_share, core, clipped_along;
  int64_t points_per_window, least_windows;
  double looks_wider, blur_px, blur_log, least_blur_px, most_blur_px;
  double bright, bright_log, bright_step_log, least_white_gray, tilt_gray, middle_px;
  double shape_share, least_noise_gray, correlated, robust, most_above;
  double radius_step_px, blur_step_log, middle_step_px, flank_step[3];
  int64_t rounds;
  double until_px, near_px, least_sigma_px;
} Rules;

/* What was found; as `clipped._Found` lays it out. Of each point of both views (2, n): how far off its middle lies, and
   how surely, infinite where it is not clipped. */
typedef struct {
  double radius_mm, blur_px[2], px_per_mm;
  uint8_t is_clipped[2];
  double *middle_px, *sigma_px;
} Found;

/* Pixels beside a curve: those of point i are start[i] .. start[i + 1] - 1, across_px left or right of it. */
typedef struct {
  int64_t *start;
  double *across_px;
  uint8_t *gray;
} Pixels;

/* A curve of n points in one view. */
typedef struct {
  int64_t n;
  double *px, *along, *half_spacing, *bend, *scale, *seen_px;
} Line;

/* A window has 7 unknowns, ordered so that those of itself alone come first: background and tilt of either side,
   middle; and log brightness of either side, which is nearly that of the next window. */
enum { OWN = 5, SHARED = 2, UNKNOWNS = OWN + SHARED, MIDDLE = 4 };
/* What borders the windows: radius and log blur; and the columns that are solved for: the gradient, and by these. */
enum { BORDER = 2, SIDES = 1 + BORDER, COLUMNS = UNKNOWNS + SIDES };
/* What a flank knows of: radius, log blur, middle, background, tilt, log brightness. */
enum { OF_FLANK = 6, SUMS = OF_FLANK * (OF_FLANK + 1) / 2 + OF_FLANK };
/* Pixels of a flank are rounded up to a whole number of vectors by some that have no weight. */
enum { LANES = 4 };

/* The clipped windows of one view and the pixels of their flanks, left and right side of each in turn.

   first (2 windows + 1): where the pixels of each flank begin; free: how many of these are not clipped, and come first;
   number: the same without padding. Of each pixel: how far from the curve, px per mm of radius, grey, 1 / sigma. */
typedef struct {
  int64_t windows, *window, *first, *free, *number;
  double *away_px, *scale, *gray, *precise;
  /* Of each flank what is solved for (background, tilt, log brightness); how near its pixels are at least; its sums. */
  double *flank, *nearest_px, *sums;
  /* Of each window: its middle; how far it is off; the precision of its step to the next; elimination and solution. */
  double *middle, *misfit, *step, *rows, *beside, *solved, *shared;
  /* The mean log brightness to begin with, of either side. */
  double first_log[2];
} View;

/* Narrows first .. last to where |slope x + at| <= most, give or take a rounding. */
static void narrow(double slope, double at, double most, double *first, double *last) {
  if (fabs(slope) < 1e-9) {
    if (fabs(at) > most + 1e-6) *last = -INFINITY;
    return;
  }
  double a = (-most - at) / slope, b = (most - at) / slope;
  double low = (a < b ? a : b) - 1e-6, high = (a < b ? b : a) + 1e-6;
  *first = low > *first ? low : *first, *last = high < *last ? high : *last;
}

/* The pixels that lie within reach_px beside each point, into `out` where there is one; otherwise only how many there may
   be. `side`: no pixel is farther than so many rows or columns. */
static int64_t beside(const Eye *eye, const Line *line, double reach_px, double side, Pixels *out) {
  int64_t count = 0;
  for (int64_t i = 0; i < line->n; i++) {
    double x = line->px[2 * i], y = line->px[2 * i + 1], ax = line->along[2 * i], ay = line->along[2 * i + 1];
    double half = line->half_spacing[i], bend = line->bend[i] / 2, most = reach_px + fabs(bend) * half * half;
    double top = fmax(rint(y) - side, 0), bottom = fmin(rint(y) + side, (double)eye->rows - 1);
    if (out) out->start[i] = count;
    for (double row = top; row <= bottom; row++) {
      double dy = row - y, first = fmax(rint(x) - side, 0) - x, last = fmin(rint(x) + side, (double)eye->columns - 1) - x;
      narrow(ax, dy * ay, half, &first, &last);
      narrow(-ay, dy * ax, most, &first, &last);
      double from = ceil(first + x), to = floor(last + x);
      if (!(from <= to)) continue;
      if (!out) {
        count += (int64_t)(to - from) + 1;
        continue;
      }
      const uint8_t *gray = eye->image + (int64_t)row * eye->stride;
      for (double column = from; column <= to; column++) {
        double dx = column - x, s = dx * ax + dy * ay, across = dy * ax - dx * ay - bend * s * s;
        if (!(s >= -half && s < half && fabs(across) < reach_px)) continue;
        out->across_px[count] = across, out->gray[count++] = gray[(int64_t)column];
      }
    }
  }
  if (out) out->start[line->n] = count;
  return count;
}

/* Central differences of v (n, 2) at i. */
static void gradient(const double *v, int64_t n, int64_t i, double *by) {
  int64_t before = i > 0 ? i - 1 : 0, after = i + 1 < n ? i + 1 : n - 1;
  for (int d = 0; d < 2; d++) by[d] = (v[2 * after + d] - v[2 * before + d]) / (double)(after - before);
}

/* The pixels beside a curve (n, 3) in this camera's frame, of a needle that looks as wide as seen_radius_mm. */
static int look_at(const Rules *r, const Eye *eye, const double *local, double seen_radius_mm, Line *line, Pixels *pixels) {
  int64_t n = line->n;
  double focal_px = (eye->own->fx + eye->own->fy) / 2, reach_px = 0, most_half = 0;
  project(eye->own, local, n, line->px);
  for (int64_t i = 0; i < n; i++) {
    double by[2];
    gradient(line->px, n, i, by);
    double length = sqrt(by[0] * by[0] + by[1] * by[1]), over = 1 / (length > 1e-300 ? length : 1e-300);
    line->along[2 * i] = by[0] * over, line->along[2 * i + 1] = by[1] * over;
    line->half_spacing[i] = length / 2;
    line->scale[i] = focal_px / local[3 * i + 2], line->seen_px[i] = seen_radius_mm * line->scale[i];
    if (!(isfinite(length) && isfinite(line->px[2 * i]) && isfinite(line->px[2 * i + 1]) && line->seen_px[i] > 0 &&
          isfinite(line->seen_px[i])))
      return NOT_CLIPPED;
    most_half = fmax(most_half, length / 2), reach_px = fmax(reach_px, line->seen_px[i]);
  }
  for (int64_t i = 0; i < n; i++) {
    double turn[2], *along = line->along + 2 * i;
    gradient(line->along, n, i, turn);
    line->bend[i] = (turn[1] * along[0] - turn[0] * along[1]) / fmax(2 * line->half_spacing[i], 1e-6);
  }
  reach_px += r->rim_px;
  double side = ceil(sqrt(reach_px * reach_px + most_half * most_half)) + 1;
  int64_t count = beside(eye, line, reach_px, side, 0);
  /* A pixel lies beside one point, or two in a bend: no needle has more of them than its picture. */
  if (count > eye->rows * eye->columns) return NOT_CLIPPED;
  pixels->start = TAKE(int64_t, n + 1), pixels->across_px = TAKE(double, count), pixels->gray = TAKE(uint8_t, count);
  if (!pixels->gray) return NO_MEMORY;
  beside(eye, line, reach_px, side, pixels);
  return FOUND;
}

/* The median of whole grey levels, of which there are count[level]. */
static double middle_gray(const int64_t *count, int64_t all) {
  int64_t below = 0, low = -1;
  for (int64_t level = 0; level < 256; level++) {
    below += count[level];
    if (low < 0 && below > (all - 1) / 2) low = level;
    if (below > all / 2) return (double)(low + level) / 2;
  }
  return 255;
}

/* The window (n,) of each point, -1: not clipped; kept (n,): which stretch each window is. Returns how many there are. */
static int64_t windows_of(const Rules *r, const Line *line, const Pixels *pixels, const uint8_t *is_shaft, int64_t *window,
                          int64_t *kept) {
  int64_t n = line->n, usable = 0, shaft = 0, windows = 0, last = n / r->points_per_window - 1;
  last = last > 0 ? last : 0;
  for (int64_t i = 0; i < n; i++) {
    int64_t count = 0, clipped = 0;
    for (int64_t k = pixels->start[i]; k < pixels->start[i + 1]; k++) {
      int is_core = fabs(pixels->across_px[k]) < r->core * line->seen_px[i];
      count += is_core, clipped += is_core && pixels->gray[k] >= r->clipped_gray;
    }
    window[i] = -1, shaft += is_shaft[i];
    if (!is_shaft[i] || !count || !((double)clipped >= r->clipped_share * (double)count)) continue;
    int64_t stretch = i / r->points_per_window;
    stretch = stretch < last ? stretch : last;
    if (!windows || kept[windows - 1] != stretch) kept[windows++] = stretch;
    window[i] = windows - 1, usable++;
  }
  return (double)usable < r->clipped_along * (double)shaft ? 0 : windows;
}

/* Which flank a pixel of a window belongs to and whether it is clipped; -1: neither, it lies inside or too far away. */
static int64_t part_of(const Rules *r, int64_t window, double across_px, double seen_px, uint8_t gray) {
  double beyond = fabs(across_px) - seen_px;
  if (window < 0 || !(beyond > -r->deep_px && beyond < r->rim_px)) return -1;
  return 2 * (2 * window + (across_px > 0)) + (gray >= r->clipped_gray);
}

/* What one view shows of a needle that it clips: no windows where it does not. */
static int seen_by(const Rules *r, const Eye *eye, const double *local, double seen_radius_mm, const uint8_t *is_shaft,
                   int64_t n, View *v) {
  memset(v, 0, sizeof *v);
  v->window = TAKE(int64_t, n);
  int64_t *kept = TAKE(int64_t, n);
  Line line = {n, TAKE(double, 2 * n), TAKE(double, 2 * n), TAKE(double, n), TAKE(double, n), TAKE(double, n), TAKE(double, n)};
  Pixels pixels;
  if (!line.seen_px) return NO_MEMORY;
  int failed = look_at(r, eye, local, seen_radius_mm, &line, &pixels);
  if (failed) return failed == NOT_CLIPPED ? FOUND : failed;
  int64_t windows = windows_of(r, &line, &pixels, is_shaft, v->window, kept), flanks = 2 * windows;
  if (!windows) return FOUND;
  int64_t *place = TAKE(int64_t, 2 * flanks), *outer = TAKE(int64_t, 256 * flanks);
  v->first = TAKE(int64_t, flanks + 1), v->free = TAKE(int64_t, flanks), v->number = TAKE(int64_t, flanks);
  v->flank = TAKE(double, 3 * flanks), v->nearest_px = TAKE(double, flanks), v->sums = TAKE(double, SUMS * flanks);
  v->middle = TAKE(double, windows), v->misfit = TAKE(double, windows), v->step = TAKE(double, windows);
  v->rows = TAKE(double, UNKNOWNS * COLUMNS * windows), v->beside = TAKE(double, BORDER * UNKNOWNS * windows);
  v->solved = TAKE(double, SIDES * UNKNOWNS * windows), v->shared = TAKE(double, 3 * windows);
  if (!v->shared) return NO_MEMORY;
  memset(place, 0, (size_t)(2 * flanks) * sizeof *place), memset(outer, 0, (size_t)(256 * flanks) * sizeof *outer);
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = pixels.start[i]; k < pixels.start[i + 1]; k++) {
      int64_t part = part_of(r, v->window[i], pixels.across_px[k], line.seen_px[i], pixels.gray[k]);
      if (part < 0) continue;
      place[part]++;
      if (fabs(pixels.across_px[k]) - line.seen_px[i] > r->rim_px / 2) outer[256 * (part / 2) + pixels.gray[k]]++;
    }
  double scattered = 0, of = 0;
  int64_t all = 0;
  for (int64_t f = 0; f < flanks; f++) {
    int64_t number = 0, *levels = outer + 256 * f;
    for (int64_t level = 0; level < 256; level++) number += levels[level];
    if (!number) return FOUND;
    double background = middle_gray(levels, number), white = fmax(r->clipped_gray - background, r->least_white_gray);
    for (int64_t level = 0; level < 256; level++)
      scattered += (double)levels[level] * fabs((double)level - background);
    of += (double)number;
    v->flank[3 * f] = background, v->flank[3 * f + 1] = 0, v->flank[3 * f + 2] = log(r->bright * white);
    v->first_log[f % 2] += v->flank[3 * f + 2] / (double)windows;
    v->first[f] = all, v->number[f] = place[2 * f], v->free[f] = (place[2 * f] + LANES - 1) / LANES * LANES;
    int64_t clipped = (place[2 * f + 1] + LANES - 1) / LANES * LANES;
    place[2 * f] = all, place[2 * f + 1] = all + v->free[f];
    all += v->free[f] + clipped;
    v->nearest_px[f] = INFINITY;
  }
  v->first[flanks] = all;
  v->away_px = TAKE(double, all), v->scale = TAKE(double, all), v->gray = TAKE(double, all), v->precise = TAKE(double, all);
  if (!v->precise) return NO_MEMORY;
  /* What pads a flank lies on the curve and weighs nothing. */
  for (int64_t k = 0; k < all; k++) v->away_px[k] = 0, v->scale[k] = 0, v->gray[k] = 0, v->precise[k] = 0;
  /* The mean departure of a normal one is 0.798 sigma. */
  double noise_gray = fmax(r->least_noise_gray, scattered / of / 0.798);
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = pixels.start[i]; k < pixels.start[i + 1]; k++) {
      int64_t part = part_of(r, v->window[i], pixels.across_px[k], line.seen_px[i], pixels.gray[k]), f = part / 2;
      if (part < 0) continue;
      int64_t at = place[part]++;
      double shape_gray = r->shape_share * fmax(pixels.gray[k] - v->flank[3 * f], 0);
      v->away_px[at] = fabs(pixels.across_px[k]), v->scale[at] = line.scale[i], v->gray[at] = pixels.gray[k];
      v->precise[at] = 1 / sqrt(noise_gray * noise_gray + shape_gray * shape_gray);
      v->nearest_px[f] = fmin(v->nearest_px[f], v->away_px[at]);
    }
  for (int64_t w = 0; w + 1 < windows; w++)
    v->step[w] = 1 / (r->bright_step_log * r->bright_step_log * (double)(kept[w + 1] - kept[w]));
  memset(v->middle, 0, (size_t)windows * sizeof *v->middle);
  v->windows = windows;
  return FOUND;
}

static const double OVER_ROOT = 0.3989422804014327; /* 1 / sqrt(2 pi) */
/* An edge so many sigmas away takes 1e-12 of the light, which no grey level shows. */
#define FAR_SIGMAS 7.0

/* Pixels of a flank, as the model has them, and by what they change: so many at a time stay in the nearest cache, and
   arrays of a known place in one structure are known not to overlap: loops over them become vectors. */
enum { BLOCK = 200 };
typedef struct {
  double level[BLOCK], slope[BLOCK], curvature[BLOCK], doubt[BLOCK];
  double by_radius[BLOCK], by_blur[BLOCK], by_middle[BLOCK], tilt[BLOCK], by_bright[BLOCK];
} Spread;

/* The level of `count` pixels `away` of the curve, whose edge is `radius_mm` times scale from their middle, and what it
   changes by. The opposite edge is as blurred; `with_far` where it is near enough to count. */
static inline __attribute__((always_inline)) void levels(const double *restrict away, const double *restrict scale,
                                                         int64_t count, double radius_mm, double blur_px, double shift_px,
                                                         const double *flank, int with_far, Spread *restrict s) {
  double over = 1 / blur_px, background = flank[0], slant = flank[1], bright = exp(flank[2]);
  double per_density = bright * OVER_ROOT;
  for (int64_t k = 0; k < count / LANES * LANES; k++) {
    double half = radius_mm * scale[k], u = away[k] - shift_px, near = (half - u) * over, t = fabs(near);
    double density = exp_negative_precise(-0.5 * t * t), beyond = density * tail(t);
    double passed = near > 0 ? 1 - beyond : beyond, sum = density, moment = density * near, difference = density;
    if (with_far) {
      double far = (half + u) * over, t2 = fabs(far), density2 = exp_negative_precise(-0.5 * t2 * t2);
      double beyond2 = density2 * tail(t2);
      passed -= far > 0 ? beyond2 : 1 - beyond2;
      sum += density2, moment += density2 * far, difference -= density2;
    }
    s->by_radius[k] = per_density * sum * over * scale[k], s->by_blur[k] = -per_density * moment;
    s->by_middle[k] = per_density * difference * over, s->by_bright[k] = bright * passed;
    s->tilt[k] = away[k] - half;
    s->level[k] = background + slant * (away[k] - half) + bright * passed;
  }
}

/* Slope and curvature by their level of the negative log likelihood of pixels that have their value; doubt: e to the
   power of how much likelier they might be, over the square of `robust`. */
static void told_by_free(const double *restrict gray, const double *restrict precise, int64_t count, double robust,
                         Spread *restrict s) {
  double over = 1 / robust;
  for (int64_t k = 0; k < count / LANES * LANES; k++) {
    double off = (s->level[k] - gray[k]) * precise[k], share = off * over, weight = 1 / (1 + share * share);
    s->doubt[k] = 1 + share * share;
    s->slope[k] = weight * off * precise[k], s->curvature[k] = weight * precise[k] * precise[k];
  }
}

/* The same of pixels from .. to - 1 that are at least white. */
static void told_by_clipped(const double *restrict precise, int64_t from, int64_t to, double white, double least,
                            double most, Spread *restrict s) {
  for (int64_t k = from; k < to; k++) {
    double above = (s->level[k] - white) * precise[k];
    above = above < least ? least : above > most ? most : above;
    double t = fabs(above), density = exp_negative_precise(-0.5 * t * t), beyond = density * tail(t);
    double mills = OVER_ROOT * density / (above > 0 ? 1 - beyond : beyond);
    s->slope[k] = -mills * precise[k], s->curvature[k] = mills * (mills + above) * precise[k] * precise[k];
  }
}

/* Adds up the upper triangle of the Hessian of a flank, each row with its gradient behind it. */
static void add_up(const Spread *s, int64_t count, double *sums) {
  const double *restrict r = s->by_radius, *restrict b = s->by_blur, *restrict m = s->by_middle, *restrict t = s->tilt;
  const double *restrict l = s->by_bright, *restrict c = s->curvature, *restrict g = s->slope;
  double rr = 0, rb = 0, rm = 0, r1 = 0, rt = 0, rl = 0, rg = 0, bb = 0, bm = 0, b1 = 0, bt = 0, bl = 0, bg = 0;
  double mm = 0, m1 = 0, mt = 0, ml = 0, mg = 0, one = 0, t1 = 0, l1 = 0, g1 = 0, tt = 0, tl = 0, tg = 0, ll = 0, lg = 0;
  /* Seven sums at a time fit into a processor's registers. */
  count = count / LANES * LANES;
  for (int64_t k = 0; k < count; k++) {
    double w = c[k] * r[k];
    rr += w * r[k], rb += w * b[k], rm += w * m[k], r1 += w, rt += w * t[k], rl += w * l[k], rg += g[k] * r[k];
  }
  for (int64_t k = 0; k < count; k++) {
    double w = c[k] * b[k];
    bb += w * b[k], bm += w * m[k], b1 += w, bt += w * t[k], bl += w * l[k], bg += g[k] * b[k];
  }
  for (int64_t k = 0; k < count; k++) {
    double w = c[k] * m[k];
    mm += w * m[k], m1 += w, mt += w * t[k], ml += w * l[k], mg += g[k] * m[k], one += c[k], g1 += g[k];
  }
  for (int64_t k = 0; k < count; k++) {
    double w = c[k] * t[k], v = c[k] * l[k];
    t1 += w, tt += w * t[k], tl += w * l[k], tg += g[k] * t[k], l1 += v, ll += v * l[k], lg += g[k] * l[k];
  }
  double all[SUMS] = {rr, rb, rm, r1, rt, rl, rg, bb, bm, b1, bt, bl, bg, mm,
                      m1, mt, ml, mg, one, t1, l1, g1, tt, tl, tg, ll, lg};
  for (int k = 0; k < SUMS; k++) sums[k] += all[k];
}

/* How far a view is from what the model has it, and how far each window is; not 0 where it is not off anywhere. */
static int normals(const Rules *r, View *v, double radius_mm, double blur_px, Spread *s, double *sorted) {
  memset(v->sums, 0, (size_t)(2 * SUMS * v->windows) * sizeof *v->sums);
  for (int64_t w = 0; w < v->windows; w++) {
    double off = 0;
    int64_t number = 0;
    for (int side = 0; side < 2; side++) {
      int64_t f = 2 * w + side, first = v->first[f], count = v->first[f + 1] - first, free = v->free[f];
      const double *flank = v->flank + 3 * f;
      double shift_px = side ? v->middle[w] : -v->middle[w];
      int has_far = v->nearest_px[f] - shift_px < FAR_SIGMAS * blur_px;
      for (int64_t from = 0; from < count; from += BLOCK) {
        int64_t here = count - from < BLOCK ? count - from : BLOCK;
        int64_t valued = free < from ? 0 : free - from < here ? free - from : here;
        const double *away = v->away_px + first + from, *scale = v->scale + first + from;
        const double *gray = v->gray + first + from, *precise = v->precise + first + from;
        if (has_far) levels(away, scale, here, radius_mm, blur_px, shift_px, flank, 1, s);
        else levels(away, scale, here, radius_mm, blur_px, shift_px, flank, 0, s);
        told_by_free(gray, precise, valued, r->robust, s);
        told_by_clipped(precise, valued, here, r->clipped_gray - 0.5, -r->robust, r->most_above, s);
        add_up(s, here, v->sums + SUMS * f);
        /* One logarithm of a product, which stays finite, for so many. */
        for (int64_t k = 0; k < valued; k += 16) {
          double product = 1;
          for (int64_t each = k; each < k + 16 && each < valued; each++) product *= s->doubt[each];
          off += r->robust * r->robust * log(product);
        }
      }
      number += v->number[f];
    }
    v->misfit[w] = off / (double)(number > 8 ? number - 7 : 1);
  }
  double usual = middle_of(v->misfit, v->windows, sorted);
  if (!(usual > 0)) return NOT_SETTLED;
  /* Where something else is beside the needle, a window has less of a say. */
  for (int64_t w = 0; w < v->windows; w++) {
    double share = v->misfit[w] / usual, weight = share > 1 ? 1 / share : 1;
    for (int k = 0; k < 2 * SUMS; k++) v->sums[2 * SUMS * w + k] *= weight;
  }
  return FOUND;
}

/* Adds what a flank says to the equations of its window, and to those of the border and their gradient. */
static void add_flank(const double *sums, int side, double (*rows)[COLUMNS], double (*beside)[BORDER], double *border,
                      double *target) {
  /* The middle moves one flank outwards and the other inwards. */
  const int own[OF_FLANK] = {-2, -1, MIDDLE, 2 * side, 2 * side + 1, OWN + side};
  double sign = side ? 1 : -1;
  for (int i = 0; i < OF_FLANK; i++) {
    for (int j = i; j < OF_FLANK; j++) {
      double sum = *sums++ * (i == 2 ? sign : 1) * (j == 2 ? sign : 1);
      if (j < BORDER) border[2 * i + j] += sum;
      else if (i < BORDER) beside[own[j]][i] += sum;
      else rows[own[i] < own[j] ? own[i] : own[j]][own[i] < own[j] ? own[j] : own[i]] += sum;
    }
    double gradient = *sums++ * (i == 2 ? sign : 1);
    if (i < BORDER) target[i] += gradient;
    else rows[own[i]][UNKNOWNS] += gradient;
  }
}

/* Eliminates what a window has to itself from its rows, of which the upper triangle is given. */
static int eliminate(double (*rows)[COLUMNS]) {
  for (int p = 0; p < OWN; p++) {
    if (!(rows[p][p] > 0)) return NOT_SETTLED;
    for (int i = p + 1; i < UNKNOWNS; i++) {
      double factor = rows[p][i] / rows[p][p];
      for (int j = i; j < COLUMNS; j++) rows[i][j] -= factor * rows[p][j];
    }
  }
  return FOUND;
}

/* A symmetric matrix (a, b; b, d), kept as a, b, d, times a vector. */
static void times(const double *m, const double *x, double *out) {
  double first = m[0] * x[0] + m[1] * x[1];
  out[1] = m[1] * x[0] + m[2] * x[1], out[0] = first;
}

/* The normal equations of a view's windows, solved for the gradient and by the border: see `View`.

   border (2, 2): by radius and log blur, upper triangle; target (2,): its gradient; both without what the windows take of
   it. */
static int band(const Rules *r, const View *v, double *border, double *target) {
  int64_t windows = v->windows;
  double of_side = 1 / ((double)windows * r->bright_log * r->bright_log);
  for (int64_t w = 0; w < windows; w++) {
    double(*rows)[COLUMNS] = (void *)(v->rows + UNKNOWNS * COLUMNS * w);
    double(*beside)[BORDER] = (void *)(v->beside + UNKNOWNS * BORDER * w);
    memset(rows, 0, UNKNOWNS * sizeof *rows), memset(beside, 0, UNKNOWNS * sizeof *beside);
    for (int side = 0; side < 2; side++) {
      const double *flank = v->flank + 3 * (2 * w + side);
      add_flank(v->sums + SUMS * (2 * w + side), side, rows, beside, border, target);
      int tilt = 2 * side + 1, log = OWN + side;
      double precision = 1 / (r->tilt_gray * r->tilt_gray);
      rows[tilt][tilt] += precision, rows[tilt][UNKNOWNS] += flank[1] * precision;
      /* Each of so many windows knows of the side as a whole its part. */
      rows[log][log] += of_side, rows[log][UNKNOWNS] += (flank[2] - v->first_log[side]) * of_side;
      if (w > 0) {
        rows[log][log] += v->step[w - 1], rows[log][UNKNOWNS] += (flank[2] - flank[2 - 6]) * v->step[w - 1];
      }
      if (w + 1 < windows) {
        rows[log][log] += v->step[w], rows[log][UNKNOWNS] += (flank[2] - flank[2 + 6]) * v->step[w];
      }
    }
    double precision = 1 / (r->middle_px * r->middle_px);
    rows[MIDDLE][MIDDLE] += precision, rows[MIDDLE][UNKNOWNS] += v->middle[w] * precision;
    for (int i = 0; i < UNKNOWNS; i++)
      for (int j = 0; j < BORDER; j++) rows[i][UNKNOWNS + 1 + j] = beside[i][j];
    if (eliminate(rows)) return NOT_SETTLED;
    double *here = v->shared + 3 * w, *a = rows[OWN] + OWN, *b = rows[OWN + 1] + OWN;
    if (w > 0) {
      /* Windows are coupled by -step, either side by itself. */
      const double *before = v->shared + 3 * (w - 1), step = v->step[w - 1];
      const double(*last)[COLUMNS] = (const void *)(v->rows + UNKNOWNS * COLUMNS * (w - 1));
      a[0] -= step * step * before[0], a[1] -= step * step * before[1], b[1] -= step * step * before[2];
      for (int c = SHARED; c < SHARED + SIDES; c++) {
        double x[2] = {last[OWN][OWN + c], last[OWN + 1][OWN + c]};
        times(before, x, x);
        a[c] += step * x[0], b[c] += step * x[1];
      }
    }
    double determinant = a[0] * b[1] - a[1] * a[1];
    if (!(a[0] > 0 && determinant > 0)) return NOT_SETTLED;
    here[0] = b[1] / determinant, here[1] = -a[1] / determinant, here[2] = a[0] / determinant;
  }
  for (int64_t w = windows - 1; w >= 0; w--) {
    const double(*rows)[COLUMNS] = (const void *)(v->rows + UNKNOWNS * COLUMNS * w);
    const double(*beside)[BORDER] = (const void *)(v->beside + UNKNOWNS * BORDER * w);
    double(*solved)[SIDES] = (void *)(v->solved + UNKNOWNS * SIDES * w), (*next)[SIDES] = solved + UNKNOWNS;
    for (int c = 0; c < SIDES; c++) {
      double x[2] = {rows[OWN][UNKNOWNS + c], rows[OWN + 1][UNKNOWNS + c]};
      if (w + 1 < windows) x[0] += v->step[w] * next[OWN][c], x[1] += v->step[w] * next[OWN + 1][c];
      times(v->shared + 3 * w, x, x);
      solved[OWN][c] = x[0], solved[OWN + 1][c] = x[1];
      for (int i = OWN - 1; i >= 0; i--) {
        double sum = rows[i][UNKNOWNS + c];
        for (int j = i + 1; j < UNKNOWNS; j++) sum -= rows[i][j] * solved[j][c];
        solved[i][c] = sum / rows[i][i];
      }
    }
    for (int i = 0; i < UNKNOWNS; i++)
      for (int a = 0; a < BORDER; a++) {
        target[a] -= beside[i][a] * solved[i][0];
        for (int b = a; b < BORDER; b++) border[2 * a + b] -= beside[i][a] * solved[i][1 + b];
      }
  }
  return FOUND;
}

/* Solves a (3, 3) for the columns of b (3, 4), by elimination with pivots; not 0 where there is no solution. */
static int solve_3(double a[3][3], double b[3][4]) {
  for (int p = 0; p < 3; p++) {
    int most = p;
    for (int i = p + 1; i < 3; i++) most = fabs(a[i][p]) > fabs(a[most][p]) ? i : most;
    if (!(fabs(a[most][p]) > 0)) return NOT_SETTLED;
    for (int j = 0; j < 3 && most != p; j++) {
      double spare = a[p][j];
      a[p][j] = a[most][j], a[most][j] = spare;
    }
    for (int j = 0; j < 4 && most != p; j++) {
      double spare = b[p][j];
      b[p][j] = b[most][j], b[most][j] = spare;
    }
    for (int i = 0; i < 3; i++) {
      if (i == p) continue;
      double factor = a[i][p] / a[p][p];
      for (int j = p; j < 3; j++) a[i][j] -= factor * a[p][j];
      for (int j = 0; j < 4; j++) b[i][j] -= factor * b[p][j];
    }
  }
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 4; j++) b[i][j] /= a[i][i];
  return FOUND;
}

static double within(double value, double most) { return value < -most ? -most : value > most ? most : value; }

/* What is known of a window's middle: the entry of the inverse of all windows' equations (Takahashi's recursion: from
   the last window back, from what is shared to what a window has to itself), and what radius and blur leave open. */
static void sure_of_middles(const Rules *r, const View *v, const double inverse[BORDER][BORDER], double *sigma_px) {
  double shared[3] = {0};
  for (int64_t w = v->windows - 1; w >= 0; w--) {
    const double(*rows)[COLUMNS] = (const void *)(v->rows + UNKNOWNS * COLUMNS * w), *own = v->shared + 3 * w;
    const double(*solved)[SIDES] = (const void *)(v->solved + UNKNOWNS * SIDES * w), *by = solved[MIDDLE] + 1;
    double here[3] = {own[0], own[1], own[2]};
    if (w + 1 < v->windows) {
      double first[2] = {own[0], own[1]}, second[2] = {own[1], own[2]}, x[2], y[2], step = v->step[w] * v->step[w];
      times(shared, first, x), times(shared, second, y);
      here[0] += step * (first[0] * x[0] + first[1] * x[1]), here[1] += step * (second[0] * x[0] + second[1] * x[1]);
      here[2] += step * (second[0] * y[0] + second[1] * y[1]);
    }
    memcpy(shared, here, sizeof shared);
    double k[2] = {rows[MIDDLE][OWN] / rows[MIDDLE][MIDDLE], rows[MIDDLE][OWN + 1] / rows[MIDDLE][MIDDLE]}, turned[2];
    times(shared, k, turned);
    double variance = 1 / rows[MIDDLE][MIDDLE] + k[0] * turned[0] + k[1] * turned[1];
    variance += inverse[0][0] * by[0] * by[0] + 2 * inverse[0][1] * by[0] * by[1] + inverse[1][1] * by[1] * by[1];
    variance *= r->correlated * fmax(1, v->misfit[w]);
    sigma_px[w] = sqrt(variance + r->least_sigma_px * r->least_sigma_px);
  }
}

/* Radius, both blurs, and the windows' middles: see `clipped.py`. before (3,): diameter and blurs, 0: not known. */
static int solve(const Rules *r, View *views, double seen_radius_mm, const double *before, Found *found) {
  int64_t most = views[0].windows > views[1].windows ? views[0].windows : views[1].windows;
  Spread *s = TAKE(Spread, 1);
  double *sorted = TAKE(double, most);
  if (!sorted) return NO_MEMORY;
  double px_per_mm = found->px_per_mm, usual = log(r->blur_px), radius_mm, log_blur[2], moved = INFINITY;
  int is_known = before[0] > 0;
  radius_mm = is_known ? before[0] / 2 : seen_radius_mm - r->looks_wider * r->blur_px / px_per_mm;
  for (int v = 0; v < 2; v++) log_blur[v] = is_known ? log(before[1 + v]) : usual;
  double inverse[3][4] = {0};
  for (int64_t round = 0; round < r->rounds && !(moved < r->until_px); round++) {
    double blur_precision = 1 / (r->blur_log * r->blur_log);
    double border[3][3] = {{1e-6, 0, 0}, {0, blur_precision, 0}, {0, 0, blur_precision}};
    double target[3] = {0, (log_blur[0] - usual) * blur_precision, (log_blur[1] - usual) * blur_precision};
    for (int k = 0; k < 2; k++) {
      View *v = views + k;
      double own[4] = {0}, by[2] = {0};
      if (!v->windows) continue;
      if (normals(r, v, radius_mm, exp(log_blur[k]), s, sorted) || band(r, v, own, by)) return NOT_SETTLED;
      border[0][0] += own[0], border[0][1 + k] += own[1], border[1 + k][0] += own[1], border[1 + k][1 + k] += own[3];
      target[0] += by[0], target[1 + k] += by[1];
    }
    double sides[3][4] = {{target[0], 1, 0, 0}, {target[1], 0, 1, 0}, {target[2], 0, 0, 1}};
    if (solve_3(border, sides)) return NOT_SETTLED;
    memcpy(inverse, sides, sizeof inverse);
    double step[3] = {-sides[0][0], -sides[1][0], -sides[2][0]};
    if (!(isfinite(step[0]) && isfinite(step[1]) && isfinite(step[2]))) return NOT_SETTLED;
    radius_mm += within(step[0], r->radius_step_px / px_per_mm);
    for (int k = 0; k < 2; k++) {
      View *v = views + k;
      double blur_px = exp(log_blur[k] + within(step[1 + k], r->blur_step_log));
      log_blur[k] = log(fmin(fmax(blur_px, r->least_blur_px), r->most_blur_px));
      for (int64_t w = 0; w < v->windows; w++) {
        const double(*solved)[SIDES] = (const void *)(v->solved + UNKNOWNS * SIDES * w);
        double *flank = v->flank + 6 * w, by[UNKNOWNS];
        for (int i = 0; i < UNKNOWNS; i++)
          by[i] = -(solved[i][0] + solved[i][1] * step[0] + solved[i][2] * step[1 + k]);
        v->middle[w] += within(by[MIDDLE], r->middle_step_px);
        for (int side = 0; side < 2; side++) {
          flank[3 * side] += within(by[2 * side], r->flank_step[0]);
          flank[3 * side + 1] += within(by[2 * side + 1], r->flank_step[1]);
          flank[3 * side + 2] += within(by[OWN + side], r->flank_step[2]);
        }
      }
    }
    moved = fmax(fabs(step[0]) * px_per_mm, fmax(fabs(step[1]), fabs(step[2])));
  }
  if (!(moved <= r->near_px && radius_mm > 0)) return NOT_SETTLED;
  found->radius_mm = radius_mm;
  for (int k = 0; k < 2; k++) {
    found->blur_px[k] = exp(log_blur[k]);
    double of[BORDER][BORDER] = {{inverse[0][1], inverse[0][2 + k]}, {inverse[1 + k][1], inverse[1 + k][2 + k]}};
    /* The misfits are those of the last round: their room is needed no more. */
    if (views[k].windows) sure_of_middles(r, views + k, of, views[k].misfit);
  }
  return FOUND;
}

typedef struct {
  const Rules *rules;
  const Eye *eyes;
  const double *points_mm, *before;
  const uint8_t *is_shaft;
  int64_t n;
  double seen_diameter_mm;
  Found *found;
} Call;

static int once(void *what) {
  Call *c = what;
  Found *o = c->found;
  int64_t n = c->n, windows = 0;
  double *local = TAKE(double, 3 * n), *depth = TAKE(double, n), *sorted = TAKE(double, n);
  if (!sorted) return NO_MEMORY;
  if (n < 2) return NOT_CLIPPED;
  View views[2];
  o->px_per_mm = 0;
  for (int k = 0; k < 2; k++) {
    const Eye *eye = c->eyes + k;
    posed(eye->posed, c->points_mm, n, local);
    int failed = seen_by(c->rules, eye, local, c->seen_diameter_mm / 2, c->is_shaft, n, views + k);
    if (failed) return failed;
    for (int64_t i = 0; i < n; i++) depth[i] = local[3 * i + 2];
    o->px_per_mm += (eye->own->fx + eye->own->fy) / 4 / middle_of(depth, n, sorted);
    windows += views[k].windows, o->is_clipped[k] = views[k].windows > 0;
  }
  if (windows < c->rules->least_windows) return NOT_CLIPPED;
  int failed = solve(c->rules, views, c->seen_diameter_mm / 2, c->before, o);
  if (failed) return failed;
  for (int k = 0; k < 2; k++)
    for (int64_t i = 0; i < n; i++) {
      int64_t window = views[k].windows ? views[k].window[i] : -1;
      o->middle_px[k * n + i] = window < 0 ? 0 : views[k].middle[window];
      o->sigma_px[k * n + i] = window < 0 ? INFINITY : views[k].misfit[window];
    }
  return FOUND;
}

/* See `clipped.clipped_axis`. before (3,): diameter in mm and both blurs in px as they were, 0: not known. */
EXPORT int clipped_axis(const Rules *rules, const Eye *eyes, const double *points_mm, int64_t n, double seen_diameter_mm,
                        const uint8_t *is_shaft, const double *before, Found *found) {
  Call call = {rules, eyes, points_mm, before, is_shaft, n, seen_diameter_mm, found};
  return with_memory(once, &call);
}
