/* A needle that was seen whole in the pair before, looked at once where it must be now: see `tracking/glance.py`.

   All of it is in one call: the parts take some ten microseconds each, about as long as an interpreter takes to put two
   of them together. */
#include <stdlib.h>

#include "kernels.h"

enum { FOUND, BEYOND, NOT_SEEN, NOT_HELD, TOO_SHORT, NO_TIP, TOO_NEAR, CLIPPED, NO_MEMORY };

/* One view; as `glance._Eye` lays it out. */
typedef struct {
  const uint8_t *image;
  int64_t rows, columns, stride;
  const Camera *own, *posed;
} Eye;

/* What is known and wanted; as `glance._Glance` lays it out. Units are those of `tracking/evidence.py`. */
typedef struct {
  /* The needle in the pair before, (before, 3) mm. */
  const double *before_mm;
  int64_t before;
  double advance_mm, taper_mm, since_s;
  /* How the curve is sampled. */
  /* A needle that is white along more than this share of it is another matter. */
  double white_gray, white_share;
  double spacing_mm, section_mm, most_advance_mm, beyond_mm, parabola_mm, least_depth_mm, least_length_mm;
  /* Sections and their evidence. */
  int64_t rows_per_section;
  const double *offsets;
  int64_t places;
  double unit_mm, least_gray, per_noise;
  const double *whitener, *half_widths;
  int64_t half_width, width_step;
  const float *const *banks, *none_bank;
  int64_t edges, shifts, fine_shifts;
  double low, step, fine_step;
  const float *refine;
  double never, outlier;
  /* Where the axis is. */
  const double *drifts;
  int64_t drift_count;
  double motion_price, floor_log, least_gain, least_sigma, used, clutter_factor;
  const double *spreads;
  int64_t looks;
  /* The streak. */
  int64_t lively;
  const double *line;
  int64_t line_length;
  const double *streak_rules;
  double streak_least_share;
  /* The fit. */
  double control_spacing_mm;
  const double *priors, *streak_shares;
  double streak_mm, streak_robust, correlation_mm, robust_px;
  int64_t rounds;
  double systematic_px, systematic_mm;
  /* The tip. */
  double tip_reach_mm, tip_before_mm, tip_beyond_mm, row_mm;
  const double *across;
  int64_t width;
  double picture_mm, reach;
  const double *picture_rules, *tip_rules, *prior;
  double log_prior, foreseen_sigma_mm;
  int64_t tip_rounds;
  /* What is beside it. */
  double diameter_mm, line_search_px, edge_spread_px, flank_px, smooth_mm, beside_before_mm, beside_beyond_mm,
      step_mm, gap_mm, crossed_mm, step_gray;
} Glance;

/* What was found; room for `room` points and `most_control` control points. */
typedef struct {
  int64_t room, most_control;
  int64_t count, control_count;
  double *parameters, *control_mm, *covariance_mm2, *points_mm, *residual_px;
  uint8_t *shown;
  double *support;
  double rms_px, streak_misfit;
  double tip[8], tip_px[4];
  int64_t is_free;
} Found;

/* Memory of this thread, given out from its start and kept from call to call: fresh pages cost more than the sums. */
static _Thread_local struct {
  char *memory;
  size_t size, used;
} arena;

static void *take(size_t bytes) {
  size_t at = arena.used;
  arena.used += (bytes + 63) & ~(size_t)63;
  return arena.used <= arena.size ? arena.memory + at : 0;
}

#define TAKE(type, count) ((type *)take((size_t)(count) * sizeof(type)))

static void lengths(const double *points, int64_t n, double *arc) {
  arc[0] = 0;
  for (int64_t i = 1; i < n; i++) {
    double x = points[3 * i] - points[3 * i - 3], y = points[3 * i + 1] - points[3 * i - 2],
           z = points[3 * i + 2] - points[3 * i - 1];
    arc[i] = arc[i - 1] + sqrt(x * x + y * y + z * z);
  }
}

/* Points at arc lengths at_mm (count,), ascending, of a polyline (n, 3) of arc lengths (n,). */
static void interpolated(const double *points, const double *arc, int64_t n, const double *at_mm, int64_t count,
                         double *out) {
  int64_t k = 0;
  for (int64_t i = 0; i < count; i++) {
    double at = at_mm[i] < 0 ? 0 : at_mm[i] > arc[n - 1] ? arc[n - 1] : at_mm[i];
    while (k < n - 2 && arc[k + 1] < at) k++;
    double step = arc[k + 1] - arc[k], share = step > 0 ? (at - arc[k]) / step : 0;
    for (int d = 0; d < 3; d++)
      out[3 * i + d] = points[3 * k + d] + share * (points[3 * k + 3 + d] - points[3 * k + d]);
  }
}

/* `count` points beyond the last of (n, 3), as a parabola whose bend is that of the last stretch. */
static void go_on(const double *points, int64_t n, int64_t count, double spacing, double over_mm, double *out) {
  int64_t last = (int64_t)rint(over_mm / spacing);
  last = last < n ? last : n;
  const double *stretch = points + 3 * (n - last), *end = points + 3 * (n - 1);
  double s = 0, s2 = 0, s3 = 0, s4 = 0, by_s[3] = {0}, by_s2[3] = {0};
  for (int64_t i = last - 2; i >= 0; i--) {
    double step = 0;
    for (int d = 0; d < 3; d++) {
      double off = stretch[3 * i + 3 + d] - stretch[3 * i + d];
      step += off * off;
    }
    s -= sqrt(step);
    s2 += s * s, s3 += s * s * s, s4 += s * s * s * s;
    for (int d = 0; d < 3; d++) {
      double off = stretch[3 * i + d] - end[d];
      by_s[d] += s * off, by_s2[d] += s * s * off;
    }
  }
  double determinant = s2 * s4 - s3 * s3, slope[3], bend[3], length = 0;
  for (int d = 0; d < 3; d++) {
    slope[d] = (s4 * by_s[d] - s3 * by_s2[d]) / determinant;
    bend[d] = (s2 * by_s2[d] - s3 * by_s[d]) / determinant;
    length += slope[d] * slope[d];
  }
  length = sqrt(length) > 1e-300 ? sqrt(length) : 1e-300;
  for (int64_t i = 0; i < count; i++) {
    double ahead = (double)(i + 1) * spacing;
    for (int d = 0; d < 3; d++) out[3 * i + d] = end[d] + ahead * slope[d] / length + ahead * ahead * bend[d];
  }
}

static void posed(const Camera *c, const double *points, int64_t n, double *local) {
  const double *r = c->rotation, *t = c->translation_mm;
  for (int64_t i = 0; i < n; i++) {
    const double *p = points + 3 * i;
    for (int d = 0; d < 3; d++) local[3 * i + d] = r[3 * d] * p[0] + r[3 * d + 1] * p[1] + r[3 * d + 2] * p[2] + t[d];
  }
}

/* Pixels without distortion of raw pixels, and what a raw pixel along `direction` is there. */
static void undistorted(const Camera *c, const double *px, const double *direction, double *here, double *ahead) {
  double ray[2], there[2] = {px[0] + direction[0], px[1] + direction[1]};
  ray_of(c, px, ray);
  here[0] = c->fx * ray[0] + c->skew * ray[1] + c->cx, here[1] = c->fy * ray[1] + c->cy;
  ray_of(c, there, ray);
  ahead[0] = c->fx * ray[0] + c->skew * ray[1] + c->cx - here[0], ahead[1] = c->fy * ray[1] + c->cy - here[1];
}

/* One view's sections about the curve and all that they tell. */
typedef struct {
  double *center, *normal, *values, *scale, *most, *expected, *offset, *sigma, *support, *streak_sigma;
  uint8_t *inside, *doubtful, *shines;
  float *relative, *likelihood;
} Told;

/* Half widths of the needle (n,) before its tip, as indices; -1 where it is thinner than all of them. */
static void tapered(const Glance *g, const double *before_tip, int64_t n, int64_t *width) {
  double thickest = g->half_widths[g->half_width], thinnest = g->half_widths[0];
  double grows = log(g->half_widths[1] / thinnest);
  for (int64_t i = 0; i < n; i++) {
    double before = before_tip[i] > 0 ? before_tip[i] : 0;
    double share = before / (g->taper_mm > 1e-6 ? g->taper_mm : 1e-6), here = thickest * (share < 1 ? share : 1);
    width[i] = -1;
    if (here < thinnest) continue;
    /* Every bank is as large as a cache: a few of them will do, and the same ones for every thickness. */
    int64_t as_thick = (int64_t)rint(log(here / thinnest) / grows), step = g->width_step;
    int64_t nearest = (as_thick + step / 2) / step * step;
    width[i] = 2 * (g->half_width - as_thick) < step || nearest >= g->half_width ? g->half_width : nearest;
  }
}

static int tell(const Glance *g, const Eye *eye, const double *local, int64_t n, const int64_t *width, Told *t) {
  int64_t places = g->places, f = features(places), s = g->shifts, p = (s + 1) / 2, most = 4 * p > 4 + 4 * g->edges ? 2 * p : 2 + 2 * g->edges;
  size_t mark = arena.used;
  double *work = TAKE(double, g->rows_per_section * n * (7 + places)), *none = TAKE(double, n),
         *log = TAKE(double, n * s);
  float *shown = TAKE(float, n * f), *both = TAKE(float, 2 * n * s), *spare = TAKE(float, 4 * n * most);
  uint8_t *cluttered = TAKE(uint8_t, n);
  double *half = TAKE(double, n), *axis = TAKE(double, n), *streak_work = TAKE(double, (3 * places + 1) * n);
  if (!streak_work) return NO_MEMORY;
  cut_sections(eye->image, eye->rows, eye->columns, eye->stride, eye->own, local, n, g->rows_per_section, g->offsets,
               places, g->unit_mm, g->least_gray, g->per_noise, work, t->center, t->normal, t->values, t->scale,
               t->inside);
  double white = 0, all = 0;
  for (int64_t i = 0; i < n; i++) {
    if (width[i] < 0 || !t->inside[i]) continue;
    const uint8_t *row = eye->image + (int64_t)rint(t->center[2 * i + 1]) * eye->stride;
    white += row[(int64_t)rint(t->center[2 * i])] >= g->white_gray, all++;
  }
  if (white >= g->white_share * all && white > 0) return CLIPPED;
  products(t->values, n, places, g->whitener, shown);
  no_needle(shown, n, places, g->none_bank, g->edges, none, spare);
  for (int64_t first = 0, last; first < n; first = last) {
    for (last = first + 1; last < n && width[last] == width[first];) last++;
    if (width[first] < 0) {
      for (int64_t k = first * s; k < last * s; k++) log[k] = -INFINITY;
      memset(cluttered + first, 0, (size_t)(last - first));
      continue;
    }
    by_background(shown + first * f, last - first, places, g->banks[width[first]], p, both, spare);
    over_none(both, none + first, last - first, s, log + first * s, cluttered + first);
  }
  prepared(log, n, s, g->refine, g->fine_shifts, g->never, (float)g->outlier, t->most, t->relative, t->likelihood);
  for (int64_t i = 0; i < n; i++)
    for (int64_t k = 0; k < s; k++) {
      double over = log[i * s + k] - t->most[i];
      log[i * s + k] = over > g->floor_log ? over : g->floor_log;
    }
  best_motion(log, n, s, g->drifts, g->drift_count, g->step, g->motion_price, g->floor_log, t->expected);
  int64_t seen = 0;
  memset(t->shines, 0, (size_t)n);
  if (g->lively) {
    for (int64_t i = 0; i < n; i++) {
      half[i] = width[i] < 0 ? 0 : g->half_widths[width[i]], axis[i] = t->expected[i];
    }
    /* The streak's offsets are handed over in place of the axis's, which follow. */
    seen = find_streak(t->values, n, places, g->line, g->line_length, g->offsets[0], g->offsets[1] - g->offsets[0],
                       half, axis, g->streak_rules, t->offset, t->streak_sigma, streak_work);
    if ((double)seen < g->streak_least_share * (double)n) seen = 0;
  }
  for (int64_t i = 0; i < n; i++) {
    t->expected[i] *= t->scale[i];
    t->shines[i] = seen > 0 && isfinite(t->streak_sigma[i]);
    t->doubtful[i] = t->shines[i] && cluttered[i];
  }
  arena.used = mark;
  return FOUND;
}

static void look(const Glance *g, Told *t, int64_t n, double spread) {
  sites(t->most, t->relative, t->likelihood, n, g->low, g->step, g->shifts, g->fine_step, g->fine_shifts, t->expected,
        spread, t->scale, t->inside, t->doubtful, g->least_gain, g->least_sigma, g->used, g->clutter_factor, t->offset,
        t->sigma, t->support);
}

static void expect(const Camera *camera, Told *t, const double *points, int64_t n, double *local, double *px) {
  posed(camera, points, n, local);
  project(camera, local, n, px);
  for (int64_t i = 0; i < n; i++)
    t->expected[i] = (px[2 * i] - t->center[2 * i]) * t->normal[2 * i] +
                     (px[2 * i + 1] - t->center[2 * i + 1]) * t->normal[2 * i + 1];
}

static float pixel(const Eye *eye, double x, double y) {
  double top = (double)eye->rows - 1, side = (double)eye->columns - 1;
  x = x < 0 ? 0 : x > side ? side : x, y = y < 0 ? 0 : y > top ? top : y;
  int64_t i = (int64_t)x, j = (int64_t)y, right = i + 1 < eye->columns ? i + 1 : i, below = j + 1 < eye->rows ? j + 1 : j;
  float u = (float)(x - (double)i), v = (float)(y - (double)j);
  const uint8_t *row = eye->image + j * eye->stride, *next = eye->image + below * eye->stride;
  return (1 - v) * ((1 - u) * row[i] + u * row[right]) + v * ((1 - u) * next[i] + u * next[right]);
}

/* Steps (2, n) of the grey of both flanks of a curve (n, 3) in the camera's frame: see `ends._steps`. */
static void flank_steps(const Glance *g, const Eye *eye, const double *local, int64_t n, double spacing, double *steps) {
  const Camera *c = eye->own;
  double *px = TAKE(double, 2 * n), *gray = TAKE(double, 2 * n), *smooth = TAKE(double, 2 * n), *width = TAKE(double, n);
  if (!width) return;
  project(c, local, n, px);
  for (int64_t i = 0; i < n; i++) width[i] = g->diameter_mm * (c->fx + c->fy) / 2 / local[3 * i + 2];
  double *sorted = smooth;
  for (int64_t i = 0; i < n; i++) {
    int64_t at = i;
    while (at > 0 && sorted[at - 1] > width[i]) sorted[at] = sorted[at - 1], at--;
    sorted[at] = width[i];
  }
  double middle = n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) / 2, inner = middle / 2 + g->edge_spread_px + 0.5;
  for (int64_t i = 0; i < n; i++) {
    const double *a = px + 2 * (i > 0 ? i - 1 : 0), *b = px + 2 * (i + 1 < n ? i + 1 : n - 1);
    double dx = b[0] - a[0], dy = b[1] - a[1], length = sqrt(dx * dx + dy * dy);
    length = length > 1e-300 ? length : 1e-300;
    for (int side = 0; side < 2; side++) {
      double sum = 0, count = 0;
      for (double off = ceil(2 * inner) / 2; off < inner + g->flank_px; off += 0.5, count++) {
        double aside = side ? off : -off;
        sum += pixel(eye, px[2 * i] - aside * dy / length, px[2 * i + 1] + aside * dx / length);
      }
      gray[side * n + i] = count ? sum / count : 0;
    }
  }
  double sigma = g->smooth_mm / spacing, kernel[3] = {1, exp(-0.5 / (sigma * sigma)), exp(-2 / (sigma * sigma))};
  double norm = kernel[0] + 2 * kernel[1] + 2 * kernel[2];
  int64_t reach = (int64_t)rint(g->step_mm / spacing), gap = (int64_t)rint(g->gap_mm / spacing);
  reach = reach < 2 ? 2 : reach, gap = gap < 1 ? 1 : gap;
  for (int side = 0; side < 2; side++) {
    double *one = gray + side * n, *flank = smooth + side * n;
    for (int64_t i = 0; i < n; i++) {
      flank[i] = 0;
      for (int64_t k = -2; k <= 2; k++) {
        int64_t at = i + k < 0 ? 0 : i + k >= n ? n - 1 : i + k;
        flank[i] += kernel[k < 0 ? -k : k] / norm * one[at];
      }
    }
    for (int64_t i = 0; i < n; i++) {
      double behind = 0, ahead = 0;
      int64_t before = 0, after = 0;
      for (int64_t k = i - gap - reach; k < i - gap; k++)
        if (k >= 0) behind += flank[k], before++;
      for (int64_t k = i + gap; k < i + gap + reach && k < n; k++) ahead += flank[k], after++;
      int enough = before >= reach / 2 && after >= reach / 2;
      steps[side * n + i] = enough ? ahead / (double)after - behind / (double)before : 0;
    }
  }
}

/* Whether something begins at at_mm on both sides of a curve (n, 3) in both views: see `ends.is_crossed`. */
static int crossed(const Glance *g, const Eye *eyes, const double *points, int64_t n, double at_mm) {
  double *steps = TAKE(double, 4 * n), *local = TAKE(double, 3 * n), *arc = TAKE(double, n);
  if (!arc) return 1;
  lengths(points, n, arc);
  for (int v = 0; v < 2; v++) {
    posed(eyes[v].posed, points, n, local);
    flank_steps(g, eyes + v, local, n, arc[1], steps + 2 * v * n);
  }
  for (int64_t i = 0; i < n; i++) {
    if (fabs(arc[i] - at_mm) > g->crossed_mm) continue;
    double least = INFINITY;
    int up = 0, down = 0;
    for (int k = 0; k < 4; k++) {
      double step = steps[k * n + i];
      least = fabs(step) < least ? fabs(step) : least, up += step > 0, down += step < 0;
    }
    if ((up == 4 || down == 4) && least > g->step_gray) return 1;
  }
  return 0;
}

/* The apex about the end of a curve that goes on, (n, 3): see `refine._tip`. found (8,) as of `find_tip`. */
static int tip_of(const Glance *g, const Eye *eyes, TipView *views, const double *along, const double *arc, int64_t n,
                  double end_mm, double *found) {
  int64_t most = (int64_t)((g->tip_before_mm + g->tip_beyond_mm) / g->row_mm) + 2, plane = most * g->width;
  double *rows_mm = TAKE(double, most), *rows = TAKE(double, 3 * most), *local = TAKE(double, 3 * most),
         *gray = TAKE(double, plane), *work = TAKE(double, 4 * plane + 16 * most),
         *tip_work = TAKE(double, (most + 1) * 19 * 16 + most + 2 * 23 * 23), *planes[2], *fixed[2], *weight[2], rules[12];
  for (int v = 0; v < 2; v++)
    planes[v] = TAKE(double, 8 * plane), fixed[v] = TAKE(double, 64), weight[v] = TAKE(double, plane);
  if (!weight[1]) return NO_MEMORY;
  double foreseen = end_mm;
  for (int64_t remaining = g->tip_rounds;;) {
    double first = end_mm - g->tip_before_mm, last = end_mm + g->tip_beyond_mm;
    first = first > 0 ? first : 0, last = last < arc[n - 1] ? last : arc[n - 1];
    int64_t count = (int64_t)ceil((last - first) / g->row_mm - 1e-9);
    if (count < 8) return NO_TIP;
    count = count < most ? count : most;
    for (int64_t i = 0; i < count; i++) rows_mm[i] = first + (double)i * g->row_mm;
    interpolated(along, arc, n, rows_mm, count, rows);
    for (int v = 0; v < 2; v++) {
      const Eye *eye = eyes + v;
      posed(eye->posed, rows, count, local);
      tip_picture(eye->image, eye->rows, eye->columns, eye->stride, eye->own, local, rows_mm, count, g->across,
                  g->width, g->unit_mm, g->reach, g->picture_rules, gray, weight[v], planes[v], fixed[v],
                  &views[v].noise_gray, work);
      views[v].weight = weight[v], views[v].weighted = planes[v], views[v].fixed = fixed[v];
    }
    memcpy(rules, g->tip_rules, sizeof rules);
    rules[8] = foreseen - end_mm, rules[9] = g->foreseen_sigma_mm;
    if (find_tip(views, 1, rows_mm, count, g->width, g->picture_mm, g->prior, g->log_prior, end_mm, rules, found,
                 tip_work))
      return NO_TIP;
    /* At the border of what was tried it may lie further on. */
    remaining--;
    double off = found[0] - end_mm;
    int inside = off > rules[0] + 0.2 && off < rules[1] - 0.2;
    if (inside || remaining == 0 || !(found[0] > g->tip_before_mm && found[0] < arc[n - 1] - g->tip_beyond_mm))
      return FOUND;
    end_mm = found[0];
  }
}

static double middle_of(const double *v, int64_t n, double *sorted) {
  for (int64_t i = 0; i < n; i++) {
    int64_t at = i;
    while (at > 0 && sorted[at - 1] > v[i]) sorted[at] = sorted[at - 1], at--;
    sorted[at] = v[i];
  }
  return n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) / 2;
}

static int glanced(const Glance *g, const Eye *eyes, TipView *views, Found *o) {
  /* Where the needle must be now, and beyond. */
  int64_t more = (int64_t)rint((g->most_advance_mm + g->beyond_mm) / g->spacing_mm), total = g->before + more;
  double *line = TAKE(double, 3 * total), *line_arc = TAKE(double, total);
  if (!line_arc) return NO_MEMORY;
  memcpy(line, g->before_mm, (size_t)(3 * g->before) * sizeof *line);
  go_on(line, g->before, more, g->spacing_mm, g->parabola_mm, line + 3 * g->before);
  lengths(line, total, line_arc);
  double advance = g->advance_mm;
  advance = advance < -g->most_advance_mm ? -g->most_advance_mm : advance > g->most_advance_mm ? g->most_advance_mm : advance;
  double foreseen = line_arc[g->before - 1] + advance, stop = foreseen + g->beyond_mm;
  int64_t n = (int64_t)rint(stop / g->section_mm) + 1;
  n = n < 8 ? 8 : n;
  if (n > o->room) return NOT_HELD;
  double *at = TAKE(double, n), *points = TAKE(double, 3 * n), *arc = TAKE(double, n), *before_tip = TAKE(double, n),
         *local = TAKE(double, 3 * n), *px = TAKE(double, 2 * n);
  int64_t *width = TAKE(int64_t, n), curve_count = 0;
  if (!width) return NO_MEMORY;
  for (int64_t i = 0; i < n; i++) at[i] = stop * (double)i / (double)(n - 1);
  interpolated(line, line_arc, total, at, n, points);
  lengths(points, n, arc);
  for (int64_t i = 0; i < n; i++) {
    before_tip[i] = foreseen - arc[i];
    curve_count += before_tip[i] >= 0;
  }
  if (curve_count < 6) return TOO_SHORT;
  tapered(g, before_tip, n, width);

  Told told[2];
  for (int v = 0; v < 2; v++) {
    Told *t = told + v;
    t->center = TAKE(double, 2 * n), t->normal = TAKE(double, 2 * n), t->values = TAKE(double, n * g->places);
    t->scale = TAKE(double, n), t->most = TAKE(double, n), t->expected = TAKE(double, n), t->offset = TAKE(double, n);
    t->sigma = TAKE(double, n), t->support = TAKE(double, n), t->streak_sigma = TAKE(double, n);
    t->inside = TAKE(uint8_t, n), t->doubtful = TAKE(uint8_t, n), t->shines = TAKE(uint8_t, n);
    t->relative = TAKE(float, n * g->shifts), t->likelihood = TAKE(float, n * g->fine_shifts);
    if (!t->likelihood) return NO_MEMORY;
    posed(eyes[v].posed, points, n, local);
    for (int64_t i = 0; i < n; i++)
      if (local[3 * i + 2] < g->least_depth_mm) return TOO_NEAR;
    int failed = tell(g, eyes + v, local, n, width, t);
    if (failed) return failed;
  }

  /* One spline for both. */
  int64_t m = (int64_t)rint(arc[n - 1] / g->control_spacing_mm) + 3;
  m = m < 5 ? 5 : m > 30 ? 30 : m;
  if (m > o->most_control) return NO_MEMORY;
  int64_t size = 3 * m, *first = TAKE(int64_t, n);
  double *u = TAKE(double, n), *mixing = TAKE(double, 4 * n), *start = TAKE(double, size), *held = TAKE(double, size * size),
         *smooth = TAKE(double, size * size), *normal = TAKE(double, size * size), *control = o->control_mm,
         *work = TAKE(double, 3 * n + 4 * size * size + 4 * size + 8 * (n + m)), *expected_line[2] = {0, 0},
         misfit[2] = {0, 0};
  if (!work) return NO_MEMORY;
  for (int64_t i = 0; i < n; i++) u[i] = arc[i] / arc[n - 1];
  basis(u, n, m, 0, first, mixing);
  if (start_of_fit(points, arc, n, m, first, mixing, g->priors, g->since_s, start, held, smooth, work)) return NOT_HELD;
  memcpy(control, start, (size_t)size * sizeof *control);
  double share = arc[n - 1] / (double)(n - 1) / g->correlation_mm;
  share = share < 1 ? share : 1;
  Sight sights[2];
  memset(sights, 0, sizeof sights);
  for (int v = 0; v < 2; v++) {
    Sight *s = sights + v;
    Told *t = told + v;
    double *here = TAKE(double, 2 * n), *ahead = TAKE(double, 2 * n);
    s->camera = eyes[v].posed, s->here_px = here, s->ahead = ahead, s->offset_px = t->offset, s->sigma_px = t->sigma;
    s->index = TAKE(int64_t, n + 2), s->residual = TAKE(double, n + 2), s->rows = TAKE(double, 12 * (n + 2));
    s->weight = TAKE(double, n + 2), s->sigma = TAKE(double, n + 2);
    if (!s->sigma) return NO_MEMORY;
    for (int64_t i = 0; i < n; i++)
      undistorted(eyes[v].own, t->center + 2 * i, t->normal + 2 * i, here + 2 * i, ahead + 2 * i);
    for (int64_t i = 0; i < n; i++) s->lines += t->shines[i];
    if (!s->lines) continue;
    int64_t *index = TAKE(int64_t, s->lines), k = 0;
    double *offset = TAKE(double, s->lines), *at_mm = TAKE(double, s->lines), *along = TAKE(double, 3 * s->lines),
           *variance = TAKE(double, s->lines);
    s->line_weighted = TAKE(double, s->lines * size), s->line_normal = TAKE(double, size * size);
    expected_line[v] = TAKE(double, s->lines * s->lines);
    size_t mark = arena.used;
    double *line_work = TAKE(double, (s->lines + size + 16) * s->lines);
    if (!line_work) return NO_MEMORY;
    double crowded = g->correlation_mm * (double)s->lines / arc[n - 1];
    for (int64_t i = 0; i < n; i++) {
      if (!t->shines[i]) continue;
      const double *a = points + 3 * (i > 0 ? i - 1 : 0), *b = points + 3 * (i + 1 < n ? i + 1 : n - 1);
      double length = 0, sigma = t->streak_sigma[i] * t->scale[i];
      for (int d = 0; d < 3; d++) along[3 * k + d] = b[d] - a[d], length += along[3 * k + d] * along[3 * k + d];
      for (int d = 0; d < 3; d++) along[3 * k + d] /= sqrt(length) > 1e-300 ? sqrt(length) : 1e-300;
      index[k] = i, offset[k] = t->offset[i] * t->scale[i], at_mm[k] = arc[i];
      variance[k] = sigma * sigma * (crowded > 1 ? crowded : 1);
      k++;
    }
    s->line_index = index, s->line_offset_px = offset;
    double radius_px = g->half_widths[g->half_width] * middle_of(t->scale, n, line_work);
    if (streak_line(s, points, first, mixing, m, at_mm, along, variance, radius_px, g->streak_shares, g->streak_mm,
                    g->streak_robust, expected_line[v], line_work))
      return NOT_HELD;
    arena.used = mark;
  }
  double *moved = TAKE(double, 3 * n), *moved_arc = TAKE(double, n);
  if (!moved_arc) return NO_MEMORY;
  for (int64_t k = 0; k < g->looks; k++) {
    for (int v = 0; v < 2; v++) look(g, told + v, n, g->spreads[k]);
    for (int again = 0; again < (k + 1 < g->looks ? 1 : 2); again++) {
      int failed = approach(sights, n, m, first, mixing, start, control, held, smooth, share, g->robust_px, g->rounds,
                            normal, work);
      if (failed) return failed == 1 ? NOT_SEEN : NOT_HELD;
    }
    curve(control, first, mixing, n, moved);
    if (k + 1 < g->looks)
      for (int v = 0; v < 2; v++) expect(eyes[v].posed, told + v, moved, n, local, px);
  }
  lengths(moved, n, moved_arc);

  /* Its tip, on the curve and beyond it. */
  int64_t beyond = (int64_t)rint(g->tip_reach_mm / g->section_mm), along_count = curve_count + beyond;
  double *along = TAKE(double, 3 * along_count), *along_arc = TAKE(double, along_count), *tip = o->tip;
  if (!along_arc) return NO_MEMORY;
  memcpy(along, moved, (size_t)(3 * curve_count) * sizeof *along);
  go_on(moved, curve_count, beyond, g->section_mm, g->parabola_mm, along + 3 * curve_count);
  lengths(along, along_count, along_arc);
  int failed = tip_of(g, eyes, views, along, along_arc, along_count, along_arc[curve_count - 1], tip);
  if (failed) return failed;
  if (tip[0] < g->least_length_mm) return TOO_SHORT;
  if (tip[0] > moved_arc[n - 1]) return BEYOND;
  int64_t index = 0;
  for (int64_t i = 1; i < n; i++) index = fabs(moved_arc[i] - tip[0]) < fabs(moved_arc[index] - tip[0]) ? i : index;

  /* What was expected where the last look looked is what supports it; its offsets stand. */
  for (int v = 0; v < 2; v++) {
    Told *t = told + v, again = *t;
    again.offset = again.sigma = 0;
    expect(eyes[v].posed, t, moved, n, local, px);
    look(g, &again, n, g->spreads[g->looks - 1]);
  }

  /* The curve once more, to the ends that both views show as well. */
  double ends[2][7];
  int64_t end_index[1] = {index};
  for (int v = 0; v < 2; v++) {
    Told *t = told + v;
    Sight *s = sights + v;
    double pair[6], pair_px[4], *end = ends[v];
    memcpy(pair, moved + 3 * (index > 0 ? index - 1 : 0), 3 * sizeof *pair);
    memcpy(pair + 3, moved + 3 * (index + 1 < n ? index + 1 : n - 1), 3 * sizeof *pair);
    double apart_mm = 0;
    for (int d = 0; d < 3; d++) apart_mm += (pair[3 + d] - pair[d]) * (pair[3 + d] - pair[d]);
    posed(eyes[v].posed, pair, 2, local);
    project(eyes[v].own, local, 2, pair_px);
    double px_per_mm = sqrt((pair_px[2] - pair_px[0]) * (pair_px[2] - pair_px[0]) +
                            (pair_px[3] - pair_px[1]) * (pair_px[3] - pair_px[1])) / sqrt(apart_mm);
    double shift = (tip[1 + v] - moved_arc[index]) * px_per_mm, sigma = tip[3 + v] * px_per_mm;
    const double *across = t->normal + 2 * index, *center = t->center + 2 * index;
    double forth[2] = {across[1], -across[0]};
    undistorted(eyes[v].own, center, forth, end, end + 2);
    end[0] += shift * end[2], end[1] += shift * end[3], end[4] = sigma > 0.5 ? sigma : 0.5;
    s->ends = 1, s->end_index = end_index, s->end_here_px = end, s->end_ahead = end + 2, s->end_sigma_px = end + 4;
    for (int d = 0; d < 2; d++)
      o->tip_px[2 * v + d] = center[d] + t->offset[index] * across[d] + shift * forth[d];
  }
  for (int again = 0; again < 2; again++) {
    failed = approach(sights, n, m, first, mixing, start, control, held, smooth, share, g->robust_px, g->rounds, normal,
                      work);
    if (failed) return failed == 1 ? NOT_SEEN : NOT_HELD;
  }
  curve(control, first, mixing, n, moved);
  lengths(moved, n, moved_arc);
  double systematic[2], *residual = TAKE(double, 2 * n);
  if (!residual) return NO_MEMORY;
  for (int v = 0; v < 2; v++) {
    if (sights[v].lines) misfit[v] = streak_misfit(sights + v, moved, expected_line[v], work);
    /* Where streak and silhouette contradict each other either may be wrong by as much. */
    systematic[v] = (misfit[v] > 1 ? misfit[v] : 1) * g->systematic_px * g->systematic_px;
  }
  if (fit_covariance(sights, n, m, first, start, control, normal, arc, systematic, g->systematic_mm, residual, &o->rms_px,
                     o->covariance_mm2, work))
    return NOT_HELD;
  o->streak_misfit = misfit[0] > misfit[1] ? misfit[0] : misfit[1];

  /* Cut at the tip. The curve as fitted once more may be a little shorter than it was. */
  double end_mm = tip[0] < moved_arc[n - 1] ? tip[0] : moved_arc[n - 1];
  int64_t count = (int64_t)rint(end_mm / g->spacing_mm) + 1, k = 0;
  count = count < 8 ? 8 : count;
  /* A curve that became so much longer than it was winds about nothing. */
  if (count > o->room) return NOT_HELD;
  for (int64_t i = 0; i < count; i++) {
    double here = end_mm * (double)i / (double)(count - 1);
    while (k < n - 2 && moved_arc[k + 1] < here) k++;
    o->parameters[i] = u[k] + (here - moved_arc[k]) / (moved_arc[k + 1] - moved_arc[k]) * (u[k + 1] - u[k]);
  }
  int64_t *cut_first = TAKE(int64_t, count);
  double *cut_mixing = TAKE(double, 4 * count);
  if (!cut_mixing) return NO_MEMORY;
  basis(o->parameters, count, m, 0, cut_first, cut_mixing);
  curve(control, cut_first, cut_mixing, count, o->points_mm);
  /* What was seen of a section is told of the point of the curve next to it. */
  for (int64_t i = 0, near = 0; i < count; i++) {
    while (near + 1 < n && fabs(u[near + 1] - o->parameters[i]) <= fabs(u[near] - o->parameters[i])) near++;
    int64_t from = i + 1 < count ? near : index;
    for (int v = 0; v < 2; v++) {
      o->residual_px[v * o->room + i] = residual[v * n + from];
      o->shown[v * o->room + i] = isfinite(told[v].sigma[from]) || told[v].shines[from];
      o->support[v * o->room + i] = told[v].support[from];
    }
  }
  o->count = count, o->control_count = m;

  /* Whether the end is free. */
  double begin = tip[0] - g->beside_before_mm, finish = tip[0] + g->beside_beyond_mm;
  begin = begin > 0 ? begin : 0;
  int64_t around = (int64_t)rint((finish - begin) / g->spacing_mm) + 1;
  around = around < 8 ? 8 : around;
  double *about_at = TAKE(double, around), *about = TAKE(double, 3 * around);
  if (!about) return NO_MEMORY;
  for (int64_t i = 0; i < around; i++) about_at[i] = begin + (finish - begin) * (double)i / (double)(around - 1);
  interpolated(along, along_arc, along_count, about_at, around, about);
  o->is_free = !crossed(g, eyes, about, around, tip[0] < g->beside_before_mm ? tip[0] : g->beside_before_mm);
  return FOUND;
}

/* See `glance.glance`. views: with the pictures of the one shape of end that the needle has. */
EXPORT int glance(const Glance *g, const Eye *eyes, TipView *views, Found *o) {
  for (;;) {
    arena.used = 0;
    int answer = glanced(g, eyes, views, o);
    if (arena.used <= arena.size) return answer;
    /* The next round has room for what this one wanted, and for what follows it. */
    size_t size = 2 * arena.used + (1u << 20);
    free(arena.memory);
    arena.memory = malloc(size), arena.size = arena.memory ? size : 0;
    if (!arena.memory) return NO_MEMORY;
  }
}
