/* A needle that was seen whole in the pair before, looked at once where it must be now: see `tracking/glance.py`.

   All of it is in one call: the parts take some ten microseconds each, about as long as an interpreter takes to put two
   of them together. */
#include "curve.h"

enum { BEYOND = OTHERS, TOO_SHORT, NO_TIP, TOO_NEAR, CLIPPED };

/* What is known and wanted; as `glance._Glance` lays it out. Units are those of `tracking/evidence.py`. */
typedef struct {
  Axis axis;
  Spline spline;
  /* The needle in the pair before, (before, 3) mm. */
  const double *before_mm;
  int64_t before;
  double advance_mm, taper_mm, since_s;
  /* Whether it is looked for roughly first: with fewer sections, on a coarser grid, without its tip. */
  int64_t roughly_first;
  Axis rough;
  double rough_section_mm;
  /* Its end is elsewhere where sections of so long a stretch say so, by so much each. */
  double end_mm, elsewhere_gain;
  /* How the curve is sampled. */
  /* A needle that is white along more than this share of it is another matter. */
  double white_share;
  /* It is looked at again, at most so often, where it lies so far aside of where it was looked for. */
  int64_t most_looks;
  double settled_mm;
  double spacing_mm, section_mm, most_advance_mm, beyond_mm, parabola_mm, least_depth_mm, least_length_mm;
  int64_t width_step;
  /* The tip. */
  double tip_reach_mm, tip_before_mm, tip_beyond_mm, row_mm;
  const double *across;
  int64_t width;
  double picture_mm, reach;
  const double *picture_rules, *tip_rules, *prior;
  double log_prior, beyond_end_mm, foreseen_off_mm, foreseen_sigma_mm;
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
  /* How often it was looked at, and how far aside of where it was looked for last it lies. */
  int64_t looks;
  double aside_mm;
  /* And how far aside its end is seen instead. */
  double elsewhere_mm;
} Found;

/* Half widths of the needle (n,) before its tip, as indices; -1 where it is thinner than all of them. */
static void tapered(const Glance *g, const double *before_tip, int64_t n, int64_t *width) {
  double thickest = g->axis.half_widths[g->axis.half_width], thinnest = g->axis.half_widths[0];
  double grows = log(g->axis.half_widths[1] / thinnest);
  for (int64_t i = 0; i < n; i++) {
    double before = before_tip[i] > 0 ? before_tip[i] : 0;
    double share = before / (g->taper_mm > 1e-6 ? g->taper_mm : 1e-6), here = thickest * (share < 1 ? share : 1);
    width[i] = -1;
    if (here < thinnest) continue;
    /* Every bank is as large as a cache: a few of them will do, and the same ones for every thickness. */
    int64_t as_thick = (int64_t)rint(log(here / thinnest) / grows), step = g->width_step;
    int64_t nearest = (as_thick + step / 2) / step * step;
    width[i] = 2 * (g->axis.half_width - as_thick) < step || nearest >= g->axis.half_width ? g->axis.half_width : nearest;
  }
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
         *tip_work = TAKE(double, 2 * ((most + 1) * 19 * 16 + most) + 2 * 23 * 23), *planes[2], *fixed[2], *weight[2], rules[12];
  for (int v = 0; v < 2; v++)
    planes[v] = TAKE(double, 8 * plane), fixed[v] = TAKE(double, 64), weight[v] = TAKE(double, plane);
  if (!weight[1]) return NO_MEMORY;
  double foreseen = end_mm + g->foreseen_off_mm;
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
                  g->width, g->axis.unit_mm, g->reach, g->picture_rules, gray, weight[v], planes[v], fixed[v],
                  &views[v].noise_gray, work);
      views[v].weight = weight[v], views[v].weighted = planes[v], views[v].fixed = fixed[v];
    }
    memcpy(rules, g->tip_rules, sizeof rules);
    rules[8] = foreseen - end_mm, rules[9] = g->foreseen_sigma_mm;
    if (find_tip(views, 1, rows_mm, count, g->width, g->picture_mm, g->prior, g->log_prior, end_mm, rules, found,
                 tip_work))
      return NO_TIP;
    /* At the border of what was tried, or well beyond where it was expected, it may lie further on. */
    remaining--;
    double off = found[0] - end_mm;
    int inside = off > rules[0] + 0.2 && off < g->beyond_end_mm;
    if (inside || remaining == 0 || !(found[0] > g->tip_before_mm && found[0] < arc[n - 1] - g->tip_beyond_mm))
      return FOUND;
    end_mm = found[0];
  }
}

/* How far aside of points (n, 3) the same points of a curve have moved, at most. */
static double farthest_aside(const double *points, const double *moved, int64_t n) {
  double most = 0;
  for (int64_t i = 0; i < n; i++) {
    const double *a = points + 3 * (i > 0 ? i - 1 : 0), *b = points + 3 * (i + 1 < n ? i + 1 : i);
    double square = 0, slid = 0, off = 0;
    for (int d = 0; d < 3; d++) {
      double step = moved[3 * i + d] - points[3 * i + d];
      square += (b[d] - a[d]) * (b[d] - a[d]), slid += (b[d] - a[d]) * step, off += step * step;
    }
    off -= slid * slid / (square > 1e-300 ? square : 1e-300);
    most = off > most ? off : most;
  }
  return sqrt(most);
}

/* Where the needle must be now, and beyond: points (n, 3) of arc lengths (n,), mm before its tip, half widths. */
typedef struct {
  int64_t n, before_its_tip;
  double foreseen_mm;
  double *points, *arc, *before_tip;
  int64_t *width;
} Course;

static int course(const Glance *g, double section_mm, int64_t room, Course *c) {
  int64_t more = (int64_t)rint((g->most_advance_mm + g->beyond_mm) / g->spacing_mm), total = g->before + more;
  double *line = TAKE(double, 3 * total), *line_arc = TAKE(double, total);
  if (!line_arc) return NO_MEMORY;
  memcpy(line, g->before_mm, (size_t)(3 * g->before) * sizeof *line);
  go_on(line, g->before, more, g->spacing_mm, g->parabola_mm, line + 3 * g->before);
  lengths(line, total, line_arc);
  double advance = g->advance_mm;
  advance = advance < -g->most_advance_mm ? -g->most_advance_mm : advance > g->most_advance_mm ? g->most_advance_mm : advance;
  c->foreseen_mm = line_arc[g->before - 1] + advance;
  double stop = c->foreseen_mm + g->beyond_mm;
  int64_t n = (int64_t)rint(stop / section_mm) + 1;
  n = n < 8 ? 8 : n;
  if (n > room) return NOT_HELD;
  double *at = TAKE(double, n);
  c->n = n, c->before_its_tip = 0;
  c->points = TAKE(double, 3 * n), c->arc = TAKE(double, n), c->before_tip = TAKE(double, n), c->width = TAKE(int64_t, n);
  if (!c->width) return NO_MEMORY;
  for (int64_t i = 0; i < n; i++) at[i] = stop * (double)i / (double)(n - 1);
  interpolated(line, line_arc, total, at, n, c->points);
  lengths(c->points, n, c->arc);
  for (int64_t i = 0; i < n; i++) {
    c->before_tip[i] = c->foreseen_mm - c->arc[i];
    c->before_its_tip += c->before_tip[i] >= 0;
  }
  if (c->before_its_tip < 6) return TOO_SHORT;
  tapered(g, c->before_tip, n, c->width);
  return FOUND;
}

/* What both views tell of it. */
static int told_of(const Glance *g, const Axis *axis, const Eye *eyes, const Course *c, Told *told) {
  double *local = TAKE(double, 3 * c->n);
  uint8_t *counted = TAKE(uint8_t, c->n);
  if (!counted) return NO_MEMORY;
  for (int v = 0; v < 2; v++) {
    Told *t = told + v;
    if (room_to_tell(axis, c->n, t)) return NO_MEMORY;
    posed(eyes[v].posed, c->points, c->n, local);
    for (int64_t i = 0; i < c->n; i++)
      if (local[3 * i + 2] < g->least_depth_mm) return TOO_NEAR;
    int failed = cut_across(axis, eyes + v, local, c->n, t);
    if (failed) return failed;
    for (int64_t i = 0; i < c->n; i++) counted[i] = c->width[i] >= 0 && t->inside[i];
    if (white_share(eyes + v, t->center, c->n, counted, axis->white_gray) >= g->white_share) return CLIPPED;
    if ((failed = weigh(axis, c->n, c->width, MOVED, t))) return failed;
  }
  return FOUND;
}

/* Where the needle is, roughly: points (count, 3) of it, to where its tip was foreseen. */
static int roughly(const Glance *g, const Eye *eyes, int64_t room, int64_t *count, double *points) {
  Course c;
  Told told[2];
  Fitting fitting;
  int failed = course(g, g->rough_section_mm, room, &c);
  if (!failed) failed = told_of(g, &g->rough, eyes, &c, told);
  if (failed) return failed;
  double *moved = TAKE(double, 3 * c.n);
  if (!moved) return NO_MEMORY;
  failed = begin_fitting(&g->rough, &g->spline, eyes, told, c.points, c.arc, c.n, g->since_s, &fitting);
  if (!failed) failed = settle(&g->rough, &g->spline, eyes, told, &fitting, moved);
  if (failed) return failed;
  *count = (int64_t)rint(c.foreseen_mm / g->spacing_mm) + 1;
  if (*count > room) return NOT_HELD;
  double *u = TAKE(double, *count), *mixing = TAKE(double, 4 * *count);
  int64_t *first = TAKE(int64_t, *count);
  if (!first) return NO_MEMORY;
  for (int64_t i = 0; i < *count; i++) u[i] = c.foreseen_mm / c.arc[c.n - 1] * (double)i / (double)(*count - 1);
  basis(u, *count, fitting.m, 0, first, mixing);
  curve(fitting.control, first, mixing, *count, points);
  return FOUND;
}

/* One look. Of a curve that will be looked at again no more is told than its points. */
static int glanced(const Glance *g, const Eye *eyes, TipView *views, int is_last, Found *o) {
  Course c;
  Told told[2];
  int failed = course(g, g->section_mm, o->room, &c);
  if (!failed) failed = told_of(g, &g->axis, eyes, &c, told);
  if (failed) return failed;
  const int64_t n = c.n, curve_count = c.before_its_tip;
  const double *points = c.points, *arc = c.arc;
  double *local = TAKE(double, 3 * n), *px = TAKE(double, 2 * n);
  if (!px) return NO_MEMORY;

  /* One spline for both. */
  Fitting fitting;
  double *moved = TAKE(double, 3 * n), *moved_arc = TAKE(double, n);
  if (!moved_arc) return NO_MEMORY;
  failed = begin_fitting(&g->axis, &g->spline, eyes, told, points, arc, n, g->since_s, &fitting);
  if (!failed && fitting.m > o->most_control) return NO_MEMORY;
  if (!failed) failed = settle(&g->axis, &g->spline, eyes, told, &fitting, moved);
  if (failed) return failed;
  lengths(moved, n, moved_arc);

  /* Its tip, on the curve and beyond it. */
  int64_t beyond = (int64_t)rint(g->tip_reach_mm / g->section_mm), along_count = curve_count + beyond;
  double *along = TAKE(double, 3 * along_count), *along_arc = TAKE(double, along_count), *tip = o->tip;
  if (!along_arc) return NO_MEMORY;
  memcpy(along, moved, (size_t)(3 * curve_count) * sizeof *along);
  go_on(moved, curve_count, beyond, g->section_mm, g->parabola_mm, along + 3 * curve_count);
  lengths(along, along_count, along_arc);
  failed = tip_of(g, eyes, views, along, along_arc, along_count, along_arc[curve_count - 1], tip);
  if (failed) return failed;
  if (tip[0] < g->least_length_mm) return TOO_SHORT;
  if (tip[0] > moved_arc[n - 1]) return BEYOND;
  int64_t index = 0;
  for (int64_t i = 1; i < n; i++) index = fabs(moved_arc[i] - tip[0]) < fabs(moved_arc[index] - tip[0]) ? i : index;

  /* What was expected where the last look looked is what supports it; its offsets stand, but where the needle is not as
     thick there as it was thought to be before its tip was found. */
  int64_t *width = TAKE(int64_t, n), thinner = 0;
  double *before_tip = TAKE(double, n), narrow = g->axis.spreads[g->axis.looks - 1];
  if (!before_tip) return NO_MEMORY;
  for (int64_t i = 0; i < n; i++) before_tip[i] = tip[0] - moved_arc[i];
  tapered(g, before_tip, n, width);
  while (thinner < n && width[thinner] == c.width[thinner]) thinner++;
  for (int v = 0; v < 2; v++) {
    Told *t = told + v, again = *t, end = told_from(&g->axis, t, thinner);
    again.offset = again.sigma = 0;
    if (thinner < n && (failed = weigh_anew(&g->axis, n - thinner, width + thinner, &end))) return failed;
    expect(eyes[v].posed, t, moved, n, local, px);
    look(&g->axis, &again, n, narrow);
    if (thinner < n) look(&g->axis, &end, n - thinner, narrow);
  }

  /* The curve once more, to the ends that both views show as well. */
  double ends[2][7];
  int64_t end_index[1] = {index};
  for (int v = 0; v < 2; v++) {
    Told *t = told + v;
    Sight *s = fitting.sights + v;
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
    see_end(eyes + v, t, index, shift, sigma > 0.5 ? sigma : 0.5, end);
    s->ends = 1, s->end_index = end_index, s->end_here_px = end, s->end_ahead = end + 2, s->end_sigma_px = end + 4;
    for (int d = 0; d < 2; d++)
      o->tip_px[2 * v + d] = center[d] + t->offset[index] * across[d] + shift * (d ? -across[0] : across[1]);
  }
  if ((failed = come_nearer(&g->spline, &fitting, 2))) return failed;
  curve(fitting.control, fitting.first, fitting.mixing, n, moved);
  lengths(moved, n, moved_arc);
  o->aside_mm = farthest_aside(points, moved, index + 1);
  /* Or is its end seen elsewhere, farther away than a look reaches? */
  int64_t stretch = (int64_t)rint(g->end_mm / g->section_mm), begin = index + 1 > stretch ? index + 1 - stretch : 0;
  double off[2];
  for (int v = 0; v < 2; v++) {
    Told *t = told + v, end = told_from(&g->axis, t, begin);
    expect(eyes[v].posed, t, moved, n, local, px);
    failed = likelier_elsewhere(&g->rough, &end, index + 1 - begin, width + begin, g->elsewhere_gain, off + v);
    if (failed) return failed;
  }
  o->elsewhere_mm = (off[0] < off[1] ? off[0] : off[1]) * g->axis.unit_mm;

  /* Cut at the tip. The curve as fitted once more may be a little shorter than it was. */
  double cut_mm = tip[0] < moved_arc[n - 1] ? tip[0] : moved_arc[n - 1];
  int64_t count = (int64_t)rint(cut_mm / g->spacing_mm) + 1, k = 0;
  count = count < 8 ? 8 : count;
  /* A curve that became so much longer than it was winds about nothing. */
  if (count > o->room) return NOT_HELD;
  for (int64_t i = 0; i < count; i++) {
    double here = cut_mm * (double)i / (double)(count - 1);
    while (k < n - 2 && moved_arc[k + 1] < here) k++;
    o->parameters[i] = fitting.u[k] + (here - moved_arc[k]) / (moved_arc[k + 1] - moved_arc[k]) * (fitting.u[k + 1] - fitting.u[k]);
  }
  int64_t *cut_first = TAKE(int64_t, count);
  double *cut_mixing = TAKE(double, 4 * count);
  if (!cut_mixing) return NO_MEMORY;
  basis(o->parameters, count, fitting.m, 0, cut_first, cut_mixing);
  curve(fitting.control, cut_first, cut_mixing, count, o->points_mm);
  o->count = count, o->control_count = fitting.m;
  if (!is_last && (o->aside_mm >= g->settled_mm || o->elsewhere_mm > 0)) return FOUND;

  double *residual = TAKE(double, 2 * n);
  if (!residual) return NO_MEMORY;
  failed = finish_fitting(&g->spline, &fitting, moved, residual, &o->rms_px, &o->streak_misfit, o->covariance_mm2);
  if (failed) return failed;
  memcpy(o->control_mm, fitting.control, (size_t)(3 * fitting.m) * sizeof(double));
  /* What was seen of a section is told of the point of the curve next to it. */
  for (int64_t i = 0, near = 0; i < count; i++) {
    while (near + 1 < n && fabs(fitting.u[near + 1] - o->parameters[i]) <= fabs(fitting.u[near] - o->parameters[i])) near++;
    int64_t from = i + 1 < count ? near : index;
    for (int v = 0; v < 2; v++) {
      o->residual_px[v * o->room + i] = residual[v * n + from];
      o->shown[v * o->room + i] = isfinite(told[v].sigma[from]) || told[v].shines[from];
      o->support[v * o->room + i] = told[v].support[from];
    }
  }

  /* Whether the end is free. */
  double from = tip[0] - g->beside_before_mm, finish = tip[0] + g->beside_beyond_mm;
  from = from > 0 ? from : 0;
  int64_t around = (int64_t)rint((finish - from) / g->spacing_mm) + 1;
  around = around < 8 ? 8 : around;
  double *about_at = TAKE(double, around), *about = TAKE(double, 3 * around);
  if (!about) return NO_MEMORY;
  for (int64_t i = 0; i < around; i++) about_at[i] = from + (finish - from) * (double)i / (double)(around - 1);
  interpolated(along, along_arc, along_count, about_at, around, about);
  o->is_free = !crossed(g, eyes, about, around, tip[0] < g->beside_before_mm ? tip[0] : g->beside_before_mm);
  return FOUND;
}

typedef struct {
  const Glance *wanted;
  const Eye *eyes;
  TipView *views;
  Found *found;
} Call;

/* Looks from where the one before found the needle, until it stays there or was looked at so often. */
static int settled(const Call *call, int64_t most_looks) {
  Glance now = *call->wanted;
  Found *o = call->found;
  size_t before_any = taken();
  double *arc = TAKE(double, now.before > o->room ? now.before : o->room), *line = TAKE(double, 3 * o->room);
  if (!line) return NO_MEMORY;
  lengths(now.before_mm, now.before, arc);
  double most = now.most_advance_mm, advance = now.advance_mm < -most ? -most : now.advance_mm > most ? most : now.advance_mm;
  double foreseen = arc[now.before - 1] + advance + now.foreseen_off_mm;
  int roughly_first = now.roughly_first != 0;
  for (int64_t look = 1;; look++) {
    size_t mark = taken();
    int is_last = look == most_looks, answer = FOUND;
    if (look == 1 ? roughly_first : o->elsewhere_mm > 0) {
      double *rough = TAKE(double, 3 * o->room);
      int64_t count;
      if (!rough) return NO_MEMORY;
      answer = roughly(&now, call->eyes, o->room, &count, rough);
      if (answer == FOUND) {
        memcpy(line, rough, (size_t)(3 * count) * sizeof *line);
        lengths(line, count, arc);
        now.before_mm = line, now.before = count, now.advance_mm = 0, now.foreseen_off_mm = foreseen - arc[count - 1];
      }
      if (answer != NO_MEMORY) give_back(mark);
    }
    /* What is not seen roughly may be seen all the same. */
    if (answer != NO_MEMORY) answer = glanced(&now, call->eyes, call->views, is_last, o);
    if (answer == NO_MEMORY) return answer;
    give_back(mark);
    if (answer != FOUND && look == 1 && !roughly_first) {
      /* It did not move before, and may have moved all at once. */
      roughly_first = 1, look = 0;
      continue;
    }
    if (answer != FOUND && look > 1) {
      /* What another look does not see is known as well as it was before. */
      give_back(before_any);
      return settled(call, look - 1);
    }
    o->looks = look;
    if (answer != FOUND || is_last || (o->aside_mm < now.settled_mm && !(o->elsewhere_mm > 0))) return answer;
    /* Where its tip is expected stays what its motion foretold: what was just seen is not to be told twice. */
    memcpy(line, o->points_mm, (size_t)(3 * o->count) * sizeof *line);
    lengths(line, o->count, arc);
    now.before_mm = line, now.before = o->count, now.advance_mm = 0;
    now.foreseen_off_mm = foreseen - arc[o->count - 1];
  }
}

static int once(void *what) {
  const Call *call = what;
  return settled(call, call->wanted->most_looks);
}

/* See `glance.glance`. views: with the pictures of the one shape of end that the needle has. */
EXPORT int glance(const Glance *g, const Eye *eyes, TipView *views, Found *o) {
  Call call = {g, eyes, views, o};
  return with_memory(once, &call);
}
