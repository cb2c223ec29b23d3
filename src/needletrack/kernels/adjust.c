/* A curve that is nearly right, adjusted to both silhouettes: see `tracking/adjust.py`. */
#include "adjust.h"

#define LOG_OF_TWO 0.6931472f

/* Scores of looks as they are asked for. */
typedef struct {
  const Looks *looks;
  const float *shown;
  int64_t n;
  float **likely;
} Scores;

static int64_t place_of(const Looks *l, const int64_t *look) { return (look[2] * l->blurs + look[1]) * l->widths + look[0]; }

/* The log evidence (n,) of a look, wherever the axis is; null where its bank is wanted. */
static const float *likely(const Scores *s, const int64_t *look) {
  const Looks *l = s->looks;
  int64_t place = place_of(l, look), p = l->reached + 1, shifts = 2 * p - 1;
  if (s->likely[place]) return s->likely[place];
  if (!l->banks[place]) {
    l->wanted[place] = 1;
    return 0;
  }
  float *most = TAKE(float, s->n);
  size_t mark = taken();
  float *both = TAKE(float, 2 * s->n * shifts), *work = TAKE(float, 4 * s->n * columns_of(p));
  if (!work) return 0;
  by_background(s->shown, s->n, l->samples, l->banks[place], l->places, p, both, work);
  for (int64_t i = 0; i < s->n; i++) {
    const float *even = both + 2 * i * shifts + p - 1, *clutter = even + shifts;
    /* One background or the other is at most twice as likely as the likelier of them: few shifts have to be summed. */
    float most_of_one = -INFINITY, top = -INFINITY;
    for (int64_t k = -l->reached; k <= l->reached; k++) {
      float more = even[k] > clutter[k] ? even[k] : clutter[k];
      most_of_one = more > most_of_one ? more : most_of_one;
    }
    for (int64_t k = -l->reached; k <= l->reached; k++) {
      float more = even[k] > clutter[k] ? even[k] : clutter[k];
      if (more < most_of_one - LOG_OF_TWO) continue;
      float here = more + log_one_plus_exp_negative(fabsf(even[k] - clutter[k]));
      top = here > top ? here : top;
    }
    most[i] = top;
  }
  give_back(mark);
  return s->likely[place] = most;
}

/* Which of `count` looks (count, 3) is likeliest, a section of something else having no more of a say than others; -1
   where a bank is wanted. */
static int64_t likeliest(const Scores *s, const int64_t *tried, int64_t count) {
  const float *each[count];
  int64_t best = 0, missing = 0;
  for (int64_t t = 0; t < count; t++) missing += (each[t] = likely(s, tried + 3 * t)) == 0;
  if (missing) return -1;
  double most[s->n], most_say = -INFINITY;
  for (int64_t i = 0; i < s->n; i++) {
    most[i] = -INFINITY;
    for (int64_t t = 0; t < count; t++) most[i] = each[t][i] > most[i] ? each[t][i] : most[i];
  }
  for (int64_t t = 0; t < count; t++) {
    double say = 0;
    for (int64_t i = 0; i < s->n; i++) {
      double less = each[t][i] - most[i];
      say += less > -s->looks->most_say ? less : -s->looks->most_say;
    }
    if (say > most_say) most_say = say, best = t;
  }
  return best;
}

/* Diameter, blur and inside under which sections are likeliest: see `silhouette.estimate_appearance`.

   shown (n, f): `products` of both views' sections; near (3,): half width, blur and inside before, -1: not known; out.
   insides: 1 where only a dull one is possible. */
static int look_of(const Looks *l, const float *shown, int64_t n, double px_per_unit, int64_t insides, int64_t *near) {
  int64_t all = 2 * l->blurs * l->widths, first = -1, last = l->blurs - 1;
  Scores s = {l, shown, n, TAKE(float *, all)};
  int64_t *tried = TAKE(int64_t, 3 * all), count = 0;
  if (!tried) return NO_MEMORY;
  memset(s.likely, 0, (size_t)all * sizeof *s.likely);
  for (int64_t b = 0; b < l->blurs; b++) {
    double px = l->blur_units[b] * px_per_unit;
    if (px < l->blur_low_px || px > l->blur_high_px) continue;
    first = first < 0 ? b : first, last = b;
  }
  first = first < 0 ? last : first;
  if (near[0] < 0) {
    for (int64_t w = l->first_width + 1; w < l->last_width; w += 3)
      for (int64_t b = first; b <= last; b++)
        for (int64_t inside = 0; inside < insides; inside++, count++)
          tried[3 * count] = w, tried[3 * count + 1] = b, tried[3 * count + 2] = inside;
    int64_t best = likeliest(&s, tried, count);
    if (best < 0) return BANK_WANTED;
    memcpy(near, tried + 3 * best, 3 * sizeof *near);
  }
  /* What is seen of a needle that is followed may look different from its first stretch. Each inside has a width and a
     blur of its own at which it explains the sections best. */
  int64_t each[2][3];
  for (int64_t inside = 0; inside < insides; inside++) {
    count = 0;
    for (int64_t w = l->first_width; w < l->last_width; w++)
      for (int64_t b = first; b <= last; b++) {
        if (w < near[0] - 2 || w > near[0] + 2 || b < near[1] - 1 || b > near[1] + 1) continue;
        tried[3 * count] = w, tried[3 * count + 1] = b, tried[3 * count + 2] = inside, count++;
      }
    if (!count) return NOT_HELD;
    int64_t best = likeliest(&s, tried, count);
    if (best < 0) return BANK_WANTED;
    memcpy(each[inside], tried + 3 * best, sizeof each[inside]);
  }
  int64_t chosen = 0;
  if (insides == 2) {
    const float *dull = likely(&s, each[0]), *lively = likely(&s, each[1]);
    double told = 0, sum = 0;
    for (int64_t i = 0; i < n; i++) {
      double gain = lively[i] - dull[i];
      told += gain > l->lively_say, sum += gain;
    }
    /* A stretch with a streak misleads where a dull inside is taken for granted; the other way round costs little. */
    chosen = told / (double)n > l->lively_share && sum / (double)n > l->dull_say;
  }
  memcpy(near, each[chosen], sizeof each[chosen]);
  return FOUND;
}

/* The nearest half widths (n,) of a needle that tapers towards its apex, as indices; -1: thinner than all of them. */
static void thinned(const Adjust *a, int64_t half_width, int64_t *width) {
  const double *all = a->axis.half_widths;
  double grows = log(all[1] / all[0]);
  for (int64_t i = 0; i < a->n; i++) {
    width[i] = half_width;
    if (!a->before_tip_mm) continue;
    double share = a->before_tip_mm[i] / (a->taper_mm > 1e-6 ? a->taper_mm : 1e-6);
    double here = all[half_width] * (share < 0 ? 0 : share < 1 ? share : 1);
    width[i] = here < all[0] ? -1 : (int64_t)rint(log(here / all[0]) / grows);
  }
}

static int estimated(const Adjust *a, const Told *told, int64_t insides, int64_t *look) {
  int64_t n = a->n, f = features(a->axis.samples), picked = 0, last = -1;
  size_t mark = taken();
  float *shown = TAKE(float, 2 * a->deciding * f), *sizes = TAKE(float, 2 * n);
  if (!sizes) return NO_MEMORY;
  for (int v = 0; v < 2; v++, last = -1)
    for (int64_t k = 0; k < a->deciding; k++) {
      int64_t at = k * (n - 1) / (a->deciding - 1);
      if (at == last) continue;
      memcpy(shown + picked++ * f, told[v].shown + at * f, (size_t)f * sizeof *shown);
      last = at;
    }
  for (int v = 0; v < 2; v++)
    for (int64_t i = 0; i < n; i++) sizes[v * n + i] = (float)told[v].scale[i];
  int failed = look_of(&a->looks, shown, picked, selected(sizes, 2 * n, n), insides, look);
  if (!failed) give_back(mark);
  return failed;
}

int room_to_adjust(int64_t n, Adjusted *o) {
  memset(o, 0, sizeof *o);
  o->control_mm = TAKE(double, 3 * MOST_CONTROL), o->covariance_mm2 = TAKE(double, 9 * MOST_CONTROL * MOST_CONTROL);
  o->parameters = TAKE(double, n), o->points_mm = TAKE(double, 3 * n), o->residual_px = TAKE(double, 2 * n);
  o->center_px = TAKE(double, 4 * n), o->normal = TAKE(double, 4 * n), o->offset_px = TAKE(double, 2 * n);
  o->sigma_px = TAKE(double, 2 * n), o->support = TAKE(double, 2 * n), o->expected_px = TAKE(double, 2 * n);
  o->streak_px = TAKE(double, 2 * n), o->streak_sigma_px = TAKE(double, 2 * n), o->px_per_unit = TAKE(double, 2 * n);
  o->shines = TAKE(uint8_t, 2 * n);
  return o->shines == 0;
}

int adjusted(const Adjust *wanted, const Eye *eyes, Adjusted *o) {
  Adjust a = *wanted;
  int64_t n = a.n, *width = TAKE(int64_t, n);
  double *arc = TAKE(double, n), *local = TAKE(double, 3 * n), *px = TAKE(double, 2 * n), ends[2][7];
  if (!px) return NO_MEMORY;
  lengths(a.points_mm, n, arc);
  Told told[2];
  for (int v = 0; v < 2; v++) {
    Told *t = told + v;
    if (room_to_tell(&a.axis, n, t)) return NO_MEMORY;
    posed(eyes[v].posed, a.points_mm, n, local);
    int failed = cut_across(&a.axis, eyes + v, local, n, t);
    if (failed) return failed;
    o->white_shares[v] = white_share(eyes + v, t->center, n, 0, a.axis.white_gray);
  }
  int64_t *look_now = o->look;
  memcpy(look_now, a.near, sizeof a.near);
  if (!a.looks_the_same) {
    /* A white needle that saturates is dull, though its profile is cut off. */
    int is_white = o->white_shares[0] > a.white_share && o->white_shares[1] > a.white_share;
    int failed = estimated(&a, told, is_white ? 1 : 2, look_now);
    if (failed) return failed;
  }
  int64_t row = (look_now[2] * a.looks.blurs + look_now[1]) * a.looks.widths, missing = 0;
  thinned(&a, look_now[0], width);
  for (int64_t i = 0; i < n; i++)
    if (width[i] >= 0 && !a.banks[row + width[i]]) a.wanted[row + width[i]] = 1, missing++;
  if (missing) return BANK_WANTED;
  a.axis.banks = a.banks + row, a.axis.none_bank = a.none_banks[look_now[1]], a.axis.half_width = look_now[0];
  a.axis.lively = a.with_streak && look_now[2] == a.lively_inside;
  a.spline.systematic_px = a.systematic_px[look_now[2]];
  for (int v = 0; v < 2; v++) {
    int failed = weigh(&a.axis, n, width, (int)a.expectation, told + v);
    if (failed) return failed;
  }
  Fitting f;
  int failed = begin_fitting(&a.axis, &a.spline, eyes, told, a.points_mm, arc, n, a.bent_for_s, &f);
  if (failed) return failed;
  for (int v = 0; v < 2; v++) {
    if (a.end_index[v] < 0) continue;
    Sight *s = f.sights + v;
    see_end(eyes + v, told + v, a.end_index[v], a.end_shift_px[v], a.end_sigma_px[v], ends[v]);
    s->ends = 1, s->end_index = a.end_index + v;
    s->end_here_px = ends[v], s->end_ahead = ends[v] + 2, s->end_sigma_px = ends[v] + 4;
  }
  if ((failed = settle(&a.axis, &a.spline, eyes, told, &f, o->points_mm))) return failed;
  if (a.with_covariance) {
    failed = finish_fitting(&a.spline, &f, o->points_mm, o->residual_px, &o->rms_px, &o->streak_misfit, o->covariance_mm2);
    if (failed) return failed;
  }
  memcpy(o->control_mm, f.control, (size_t)(3 * f.m) * sizeof(double));
  memcpy(o->parameters, f.u, (size_t)n * sizeof(double));
  o->control_count = f.m;
  for (int v = 0; v < 2; v++) {
    Told *t = told + v, again = *t;
    again.offset = again.sigma = 0;
    expect(eyes[v].posed, t, o->points_mm, n, local, px);
    look(&a.axis, &again, n, a.axis.spreads[a.axis.looks - 1]);
    o->white_shares[v] = white_share(eyes + v, px, n, 0, a.axis.white_gray);
    size_t all = (size_t)n * sizeof(double);
    memcpy(o->center_px + 2 * v * n, t->center, 2 * all), memcpy(o->normal + 2 * v * n, t->normal, 2 * all);
    memcpy(o->offset_px + v * n, t->offset, all), memcpy(o->sigma_px + v * n, t->sigma, all);
    memcpy(o->support + v * n, t->support, all), memcpy(o->expected_px + v * n, t->expected, all);
    memcpy(o->px_per_unit + v * n, t->scale, all), memcpy(o->shines + v * n, t->shines, (size_t)n);
    for (int64_t i = 0; i < n; i++) {
      o->streak_px[v * n + i] = t->shines[i] ? t->streak[i] * t->scale[i] : 0;
      o->streak_sigma_px[v * n + i] = t->shines[i] ? t->streak_sigma[i] * t->scale[i] : INFINITY;
    }
  }
  return FOUND;
}

typedef struct {
  const Adjust *wanted;
  const Eye *eyes;
  Adjusted *found;
} Call;

static int once(void *what) {
  Call *call = what;
  return adjusted(call->wanted, call->eyes, call->found);
}

/* See `adjust.adjust`. */
EXPORT int adjust(const Adjust *a, const Eye *eyes, Adjusted *o) {
  Call call = {a, eyes, o};
  return with_memory(once, &call);
}

typedef struct {
  const Looks *looks;
  const float *shown;
  int64_t n, insides, *near;
  double px_per_unit;
} LookCall;

static int look_once(void *what) {
  LookCall *call = what;
  int64_t near[3];
  memcpy(near, call->near, sizeof near);
  int failed = look_of(call->looks, call->shown, call->n, call->px_per_unit, call->insides, near);
  if (!failed) memcpy(call->near, near, sizeof near);
  return failed;
}

/* See `silhouette.estimate_appearance`; `look_of` for sections that are at hand. */
EXPORT int appearance_of(const Looks *l, const float *shown, int64_t n, double px_per_unit, int64_t insides,
                         int64_t *near) {
  LookCall call = {l, shown, n, insides, near, px_per_unit};
  return with_memory(look_once, &call);
}
