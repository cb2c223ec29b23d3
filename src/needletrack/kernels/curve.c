/* A curve in space, seen by both views: see `curve.h`. */
#include "curve.h"

#include <stdlib.h>

static _Thread_local struct {
  char *memory;
  size_t size, used;
} arena;

void *take(size_t bytes) {
  size_t at = arena.used;
  arena.used += (bytes + 63) & ~(size_t)63;
  return arena.used <= arena.size ? arena.memory + at : 0;
}

size_t taken(void) { return arena.used; }

void give_back(size_t mark) { arena.used = mark; }

int with_memory(int (*once)(void *), void *what) {
  for (;;) {
    arena.used = 0;
    int answer = once(what);
    if (arena.used <= arena.size) return answer;
    /* The next round has room for what this one wanted, and for what follows it. */
    size_t size = 2 * arena.used + (1u << 20);
    free(arena.memory);
    arena.memory = malloc(size), arena.size = arena.memory ? size : 0;
    if (!arena.memory) return NO_MEMORY;
  }
}

void lengths(const double *points, int64_t n, double *arc) {
  arc[0] = 0;
  for (int64_t i = 1; i < n; i++) {
    double x = points[3 * i] - points[3 * i - 3], y = points[3 * i + 1] - points[3 * i - 2],
           z = points[3 * i + 2] - points[3 * i - 1];
    arc[i] = arc[i - 1] + sqrt(x * x + y * y + z * z);
  }
}

void interpolated(const double *points, const double *arc, int64_t n, const double *at_mm, int64_t count,
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

void go_on(const double *points, int64_t n, int64_t count, double spacing, double over_mm, double *out) {
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

void posed(const Camera *c, const double *points, int64_t n, double *local) {
  const double *r = c->rotation, *t = c->translation_mm;
  for (int64_t i = 0; i < n; i++) {
    const double *p = points + 3 * i;
    for (int d = 0; d < 3; d++) local[3 * i + d] = r[3 * d] * p[0] + r[3 * d + 1] * p[1] + r[3 * d + 2] * p[2] + t[d];
  }
}

void undistorted(const Camera *c, const double *px, const double *direction, double *here, double *ahead) {
  double ray[2], there[2] = {px[0] + direction[0], px[1] + direction[1]};
  ray_of(c, px, ray);
  here[0] = c->fx * ray[0] + c->skew * ray[1] + c->cx, here[1] = c->fy * ray[1] + c->cy;
  ray_of(c, there, ray);
  ahead[0] = c->fx * ray[0] + c->skew * ray[1] + c->cx - here[0], ahead[1] = c->fy * ray[1] + c->cy - here[1];
}

double middle_of(const double *v, int64_t n, double *sorted) {
  for (int64_t i = 0; i < n; i++) {
    int64_t at = i;
    while (at > 0 && sorted[at - 1] > v[i]) sorted[at] = sorted[at - 1], at--;
    sorted[at] = v[i];
  }
  return n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) / 2;
}

double white_share(const Eye *eye, const double *px, int64_t n, const uint8_t *counted, double white_gray) {
  double white = 0, all = 0;
  for (int64_t i = 0; i < n; i++) {
    double x = px[2 * i], y = px[2 * i + 1];
    if ((counted && !counted[i]) || !(x >= 0 && y >= 0 && x <= (double)eye->columns - 1 && y <= (double)eye->rows - 1))
      continue;
    white += eye->image[(int64_t)rint(y) * eye->stride + (int64_t)rint(x)] >= white_gray, all++;
  }
  return all > 0 ? white / all : 0;
}

static int64_t shifts_of(const Axis *a) { return 2 * a->places - 1; }

int room_to_tell(const Axis *a, int64_t n, Told *t) {
  t->center = TAKE(double, 2 * n), t->normal = TAKE(double, 2 * n), t->values = TAKE(double, n * a->samples);
  t->scale = TAKE(double, n), t->none = TAKE(double, n), t->most = TAKE(double, n), t->expected = TAKE(double, n);
  t->offset = TAKE(double, n), t->sigma = TAKE(double, n), t->support = TAKE(double, n);
  t->streak = TAKE(double, n), t->streak_sigma = TAKE(double, n);
  t->inside = TAKE(uint8_t, n), t->cluttered = TAKE(uint8_t, n), t->doubtful = TAKE(uint8_t, n);
  t->shines = TAKE(uint8_t, n), t->shown = TAKE(float, n * features(a->samples));
  t->relative = TAKE(float, n * shifts_of(a)), t->likelihood = TAKE(float, n * a->fine_shifts);
  return t->likelihood == 0;
}

int cut_across(const Axis *a, const Eye *eye, const double *local, int64_t n, Told *t) {
  size_t mark = taken();
  double *work = TAKE(double, a->rows_per_section * n * (7 + a->samples));
  if (!work) return NO_MEMORY;
  cut_sections(eye->image, eye->rows, eye->columns, eye->stride, eye->own, local, n, a->rows_per_section, a->offsets,
               a->samples, a->unit_mm, a->least_gray, a->per_noise, work, t->center, t->normal, t->values, t->scale,
               t->inside);
  products(t->values, n, a->samples, a->whitener, t->shown);
  give_back(mark);
  return FOUND;
}

/* The evidence of n sections of these half widths, over that of no needle. log (n, shifts): out. */
static int needle_or_none(const Axis *a, int64_t n, const int64_t *width, Told *t, double *log) {
  int64_t samples = a->samples, f = features(samples), s = shifts_of(a), p = a->places;
  size_t mark = taken();
  float *both = TAKE(float, 2 * n * s), *spare = TAKE(float, 4 * n * columns_of(p));
  if (!spare) return NO_MEMORY;
  for (int64_t first = 0, last; first < n; first = last) {
    for (last = first + 1; last < n && width[last] == width[first];) last++;
    if (width[first] < 0) {
      for (int64_t k = first * s; k < last * s; k++) log[k] = -INFINITY;
      memset(t->cluttered + first, 0, (size_t)(last - first));
      continue;
    }
    by_background(t->shown + first * f, last - first, samples, a->banks[width[first]], p, p, both, spare);
    over_none(both, t->none + first, last - first, s, log + first * s, t->cluttered + first);
  }
  prepared(log, n, s, a->refine, a->fine_shifts, a->never, (float)a->outlier, t->most, t->relative, t->likelihood);
  give_back(mark);
  return FOUND;
}

int weigh(const Axis *a, int64_t n, const int64_t *width, int expectation, Told *t) {
  if (n < 1) return NOT_HELD;
  int64_t samples = a->samples, s = shifts_of(a), p = a->places;
  size_t mark = taken();
  double *log = TAKE(double, n * s), *half = TAKE(double, n), *axis = TAKE(double, n),
         *streak_work = TAKE(double, (3 * samples + 1) * n);
  float *spare = TAKE(float, 4 * n * columns_of(a->edges + 1));
  int64_t *path = TAKE(int64_t, n);
  if (!path) return NO_MEMORY;
  no_needle(t->shown, n, samples, a->none_bank, a->edges, t->none, spare);
  int failed = needle_or_none(a, n, width, t, log);
  if (failed) return failed;
  double low = -a->step * (double)(p - 1);
  if (expectation == STAYED) memset(t->expected, 0, (size_t)n * sizeof(double));
  else {
    for (int64_t i = 0; i < n; i++)
      for (int64_t k = 0; k < s; k++) {
        double over = log[i * s + k] - t->most[i];
        log[i * s + k] = over > a->floor_log ? over : a->floor_log;
      }
    if (expectation == MOVED)
      best_motion(log, n, s, a->drifts, a->drift_count, a->step, a->motion_price, a->floor_log, t->expected);
    else {
      best_path(log, n, s, a->turn_price * a->step, path);
      for (int64_t i = 0; i < n; i++) t->expected[i] = low + a->step * (double)path[i];
    }
  }
  int64_t seen = 0;
  memset(t->shines, 0, (size_t)n);
  if (a->lively) {
    for (int64_t i = 0; i < n; i++) half[i] = width[i] < 0 ? 0 : a->half_widths[width[i]], axis[i] = t->expected[i];
    seen = find_streak(t->values, n, samples, a->line, a->line_length, a->offsets[0], a->offsets[1] - a->offsets[0],
                       half, axis, a->streak_rules, t->streak, t->streak_sigma, streak_work);
    if ((double)seen < a->streak_least_share * (double)n) seen = 0;
  }
  for (int64_t i = 0; i < n; i++) {
    t->expected[i] *= t->scale[i];
    t->shines[i] = seen > 0 && isfinite(t->streak_sigma[i]);
    t->doubtful[i] = t->shines[i] && t->cluttered[i];
  }
  give_back(mark);
  return FOUND;
}

Told told_from(const Axis *a, const Told *t, int64_t first) {
  Told from = *t;
  from.center += 2 * first, from.normal += 2 * first, from.values += first * a->samples;
  from.scale += first, from.none += first, from.most += first, from.expected += first;
  from.offset += first, from.sigma += first, from.support += first;
  from.streak += first, from.streak_sigma += first;
  from.inside += first, from.cluttered += first, from.doubtful += first, from.shines += first;
  from.shown += first * features(a->samples);
  from.relative += first * shifts_of(a), from.likelihood += first * a->fine_shifts;
  return from;
}

int weigh_anew(const Axis *a, int64_t n, const int64_t *width, Told *t) {
  size_t mark = taken();
  double *log = TAKE(double, n * shifts_of(a));
  if (!log) return NO_MEMORY;
  int failed = needle_or_none(a, n, width, t, log);
  if (failed) return failed;
  for (int64_t i = 0; i < n; i++) t->doubtful[i] = t->shines[i] && t->cluttered[i];
  give_back(mark);
  return FOUND;
}

/* Log evidence of places of a grid (s,), over `most`, at a place between two of them; no less than `floor_log`. */
static double evidence_at(const double *log, int64_t s, double place, double most, double floor_log) {
  if (!(place >= 0 && place <= (double)(s - 1))) return floor_log;
  int64_t k = (int64_t)place < s - 1 ? (int64_t)place : s - 2;
  double over = log[k] + (place - (double)k) * (log[k + 1] - log[k]) - most;
  return over > floor_log ? over : floor_log;
}

int likelier_elsewhere(const Axis *a, const Told *told, int64_t n, const int64_t *width, double least_gain, double *off) {
  int64_t s = shifts_of(a), counted = 0;
  size_t mark = taken();
  Told t = *told;
  double *log = TAKE(double, n * s), *place = TAKE(double, n), best, here = 0;
  t.most = TAKE(double, n), t.relative = TAKE(float, n * s), t.likelihood = TAKE(float, n * a->fine_shifts);
  t.cluttered = TAKE(uint8_t, n);
  if (!t.cluttered) return NO_MEMORY;
  int failed = needle_or_none(a, n, width, &t, log);
  if (failed) return failed;
  for (int64_t i = 0; i < n; i++) {
    place[i] = width[i] < 0 || !t.inside[i] ? NAN : t.expected[i] / t.scale[i] / a->step + (double)(s - 1) / 2;
    counted += place[i] >= 0;
    if (place[i] >= 0) here += evidence_at(log + i * s, s, place[i], t.most[i], a->floor_log);
  }
  *off = 0, best = here + least_gain * (double)counted;
  for (int turn = -2; turn <= 2; turn++)
    for (int64_t shift = 1 - s; shift < s; shift++) {
      double sum = 0, aside = (double)shift * a->step, most = fabs(aside) + fabs(turn / 2.0);
      for (int64_t i = 0; i < n; i++) {
        double here_aside = aside + turn * ((double)i / (double)n - 0.5);
        if (place[i] >= 0) sum += evidence_at(log + i * s, s, place[i] + here_aside / a->step, t.most[i], a->floor_log);
      }
      if (sum > best) best = sum, *off = most;
    }
  give_back(mark);
  return FOUND;
}

void look(const Axis *a, Told *t, int64_t n, double spread) {
  sites(t->most, t->relative, t->likelihood, n, -a->step * (double)(a->places - 1), a->step, shifts_of(a),
        a->fine_step, a->fine_shifts, t->expected, spread, t->scale, t->inside, t->doubtful, a->least_gain,
        a->least_sigma, a->used, a->clutter_factor, t->offset, t->sigma, t->support);
}

void expect(const Camera *camera, Told *t, const double *points, int64_t n, double *local, double *px) {
  posed(camera, points, n, local);
  project(camera, local, n, px);
  for (int64_t i = 0; i < n; i++)
    t->expected[i] = (px[2 * i] - t->center[2 * i]) * t->normal[2 * i] +
                     (px[2 * i + 1] - t->center[2 * i + 1]) * t->normal[2 * i + 1];
}

/* The streak's line beside the axis in one view, as one more thing that its sight measures. */
static int see_streak(const Axis *a, const Spline *spline, const Told *t, Fitting *f, int v) {
  Sight *s = f->sights + v;
  int64_t n = f->n, size = 3 * f->m, *index = TAKE(int64_t, s->lines), k = 0;
  double *offset = TAKE(double, s->lines), *at_mm = TAKE(double, s->lines), *along = TAKE(double, 3 * s->lines),
         *variance = TAKE(double, s->lines);
  s->line_weighted = TAKE(double, s->lines * size), s->line_normal = TAKE(double, size * size);
  f->expected_line[v] = TAKE(double, s->lines * s->lines);
  size_t mark = taken();
  double *line_work = TAKE(double, (s->lines + size + 16) * s->lines), *sorted = TAKE(double, n);
  if (!sorted) return NO_MEMORY;
  /* Neighbouring sections blur into one another as those of the silhouette do. */
  double crowded = spline->correlation_mm * (double)s->lines / f->arc[n - 1];
  for (int64_t i = 0; i < n; i++) {
    if (!t->shines[i]) continue;
    const double *before = f->points + 3 * (i > 0 ? i - 1 : 0), *after = f->points + 3 * (i + 1 < n ? i + 1 : n - 1);
    double length = 0, sigma = t->streak_sigma[i] * t->scale[i];
    for (int d = 0; d < 3; d++) along[3 * k + d] = after[d] - before[d], length += along[3 * k + d] * along[3 * k + d];
    for (int d = 0; d < 3; d++) along[3 * k + d] /= sqrt(length) > 1e-300 ? sqrt(length) : 1e-300;
    index[k] = i, offset[k] = t->streak[i] * t->scale[i], at_mm[k] = f->arc[i];
    variance[k] = sigma * sigma * (crowded > 1 ? crowded : 1);
    k++;
  }
  s->line_index = index, s->line_offset_px = offset;
  double radius_px = a->half_widths[a->half_width] * middle_of(t->scale, n, sorted);
  int failed = streak_line(s, f->points, f->first, f->mixing, f->m, at_mm, along, variance, radius_px,
                           spline->streak_shares, spline->streak_mm, spline->streak_robust, f->expected_line[v],
                           line_work);
  give_back(mark);
  return failed ? NOT_HELD : FOUND;
}

int begin_fitting(const Axis *a, const Spline *spline, const Eye *eyes, const Told *told, const double *points,
                  const double *arc, int64_t n, double bent_for_s, Fitting *f) {
  int64_t m = (int64_t)rint(arc[n - 1] / spline->control_spacing_mm) + 3;
  m = m < 5 ? 5 : m > MOST_CONTROL ? MOST_CONTROL : m;
  int64_t size = 3 * m;
  memset(f, 0, sizeof *f);
  f->n = n, f->m = m, f->points = points, f->arc = arc;
  f->first = TAKE(int64_t, n), f->u = TAKE(double, n), f->mixing = TAKE(double, 4 * n);
  f->start = TAKE(double, size), f->held = TAKE(double, size * size), f->smooth = TAKE(double, size * size);
  f->normal = TAKE(double, size * size), f->control = TAKE(double, size);
  f->work = TAKE(double, 3 * n + 4 * size * size + 4 * size + 8 * (n + m));
  if (!f->work) return NO_MEMORY;
  for (int64_t i = 0; i < n; i++) f->u[i] = arc[i] / arc[n - 1];
  basis(f->u, n, m, 0, f->first, f->mixing);
  if (start_of_fit(points, arc, n, m, f->first, f->mixing, spline->priors, bent_for_s, f->start, f->held, f->smooth,
                   f->work))
    return NOT_HELD;
  memcpy(f->control, f->start, (size_t)size * sizeof *f->control);
  double share = arc[n - 1] / (double)(n - 1) / spline->correlation_mm;
  f->share = share < 1 ? share : 1;
  for (int v = 0; v < 2; v++) {
    Sight *s = f->sights + v;
    const Told *t = told + v;
    double *here = TAKE(double, 2 * n), *ahead = TAKE(double, 2 * n);
    s->camera = eyes[v].posed, s->here_px = here, s->ahead = ahead, s->offset_px = t->offset, s->sigma_px = t->sigma;
    s->index = TAKE(int64_t, n + 2), s->residual = TAKE(double, n + 2), s->rows = TAKE(double, 12 * (n + 2));
    s->weight = TAKE(double, n + 2), s->sigma = TAKE(double, n + 2);
    if (!s->sigma) return NO_MEMORY;
    for (int64_t i = 0; i < n; i++)
      undistorted(eyes[v].own, t->center + 2 * i, t->normal + 2 * i, here + 2 * i, ahead + 2 * i);
    for (int64_t i = 0; i < n; i++) s->lines += t->shines[i];
    int failed = s->lines ? see_streak(a, spline, t, f, v) : FOUND;
    if (failed) return failed;
  }
  return FOUND;
}

int come_nearer(const Spline *s, Fitting *f, int steps) {
  for (int step = 0; step < steps; step++) {
    int failed = approach(f->sights, f->n, f->m, f->first, f->mixing, f->start, f->control, f->held, f->smooth,
                          f->share, s->robust_px, s->rounds, f->normal, f->work);
    if (failed) return failed == 1 ? NOT_SEEN : NOT_HELD;
  }
  return FOUND;
}

int settle(const Axis *a, const Spline *s, const Eye *eyes, Told *told, Fitting *f, double *moved) {
  int64_t n = f->n;
  size_t mark = taken();
  double *local = TAKE(double, 3 * n), *px = TAKE(double, 2 * n);
  if (!px) return NO_MEMORY;
  for (int64_t k = 0; k < a->looks; k++) {
    int is_last = k + 1 == a->looks;
    for (int v = 0; v < 2; v++) look(a, told + v, n, a->spreads[k]);
    int failed = come_nearer(s, f, is_last ? 2 : 1);
    if (failed) return failed;
    curve(f->control, f->first, f->mixing, n, moved);
    if (!is_last)
      for (int v = 0; v < 2; v++) expect(eyes[v].posed, told + v, moved, n, local, px);
  }
  give_back(mark);
  return FOUND;
}

void see_end(const Eye *eye, const Told *t, int64_t index, double shift_px, double sigma_px, double *end) {
  /* At an end the curve is measured along itself, which is the normal turned by a quarter. */
  double forth[2] = {t->normal[2 * index + 1], -t->normal[2 * index]};
  undistorted(eye->own, t->center + 2 * index, forth, end, end + 2);
  end[0] += shift_px * end[2], end[1] += shift_px * end[3], end[4] = sigma_px;
}

int finish_fitting(const Spline *s, Fitting *f, const double *moved, double *residual, double *rms_px, double *misfit,
                   double *covariance) {
  double systematic[2];
  *misfit = 0;
  for (int v = 0; v < 2; v++) {
    double off = f->sights[v].lines ? streak_misfit(f->sights + v, moved, f->expected_line[v], f->work) : 0;
    *misfit = off > *misfit ? off : *misfit;
    /* Where streak and silhouette contradict each other either may be wrong by as much. */
    systematic[v] = (off > 1 ? off : 1) * s->systematic_px * s->systematic_px;
  }
  return fit_covariance(f->sights, f->n, f->m, f->first, f->start, f->control, f->normal, f->arc, systematic,
                        s->systematic_mm, residual, rms_px, covariance, f->work)
             ? NOT_HELD
             : FOUND;
}
