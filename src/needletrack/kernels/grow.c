/* A rough curve followed to the needle's ends, round by round: see `tracking/grow.py`. */
#include "adjust.h"

enum { TOO_LONG = OTHERS_STILL, TOO_SHORT };

/* What is known and wanted; as `grow._Grow` lays it out. */
typedef struct {
  /* The first round, and those that follow; their curves are put in. */
  const Adjust *rough, *growing;
  const double *points_mm;
  int64_t n, near[3];
  /* Lengths by which the curve is lengthened beyond its ends while it grows, and where it grows no more; the longest. */
  const double *reaches_mm;
  int64_t reaches;
  double farthest_mm, spacing_mm, parabola_mm, settled_mm, shown_log_odds, shown_share, shown_over_mm, max_gap_mm, goes_on_mm;
  int64_t rounds;
  double longest_mm, shortest_mm;
} Grow;

/* What was found; room for `room` points. */
typedef struct {
  int64_t room, count, look[3];
  double *points_mm;
} Grown;

static int64_t points_of(double length_mm, double spacing_mm) {
  int64_t count = (int64_t)rint(length_mm / spacing_mm) + 1;
  return count < 8 ? 8 : count;
}

/* A polyline (n, 3) evenly spaced, with room for `margin` more points before it and after it; null without memory. */
static double *evenly(const double *points, int64_t n, double spacing_mm, int64_t margin, int64_t *count) {
  double *arc = TAKE(double, n);
  if (!arc) return 0;
  lengths(points, n, arc);
  *count = points_of(arc[n - 1], spacing_mm);
  double *at = TAKE(double, *count), *out = TAKE(double, 3 * (*count + 2 * margin));
  if (!out) return 0;
  for (int64_t i = 0; i < *count; i++) at[i] = arc[n - 1] * (double)i / (double)(*count - 1);
  interpolated(points, arc, n, at, *count, out + 3 * margin);
  return out;
}

static void turned(const double *points, int64_t n, double *out) {
  for (int64_t i = 0; i < n; i++) memcpy(out + 3 * i, points + 3 * (n - 1 - i), 3 * sizeof *out);
}

/* Points (n, 3), evenly spaced and lengthened beyond both ends by a parabola each; null without memory. */
static double *lengthened(const Grow *g, const double *points, int64_t n, double reach_mm, int64_t *count) {
  int64_t more = (int64_t)rint(reach_mm / g->spacing_mm), even;
  double *out = evenly(points, n, g->spacing_mm, more, &even);
  if (!out) return 0;
  double *back = TAKE(double, 3 * even), *before = TAKE(double, 3 * more), *middle = out + 3 * more;
  if (!before) return 0;
  turned(middle, even, back);
  go_on(back, even, more, g->spacing_mm, g->parabola_mm, before);
  turned(before, more, out);
  go_on(middle, even, more, g->spacing_mm, g->parabola_mm, middle + 3 * even);
  *count = even + 2 * more;
  return out;
}

/* The longest stretch start <= i < stop of n points of which the views show a needle, gaps bridged; 0: they show none. */
static int shown(const Grow *g, const double *support, int64_t n, int64_t *start, int64_t *stop) {
  int64_t window = (int64_t)rint(g->shown_over_mm / g->spacing_mm), longest_gap = (int64_t)floor(g->max_gap_mm / g->spacing_mm);
  window = window < 3 ? 3 : window;
  double views[n], most = -1, sum = 0;
  for (int64_t i = 0; i < n; i++)
    views[i] = ((support[i] > g->shown_log_odds) + (support[n + i] > g->shown_log_odds)) / 2.0;
  int64_t first = -1, last = -1;
  for (int64_t i = 0; i < n; i++) {
    double mean = 0;
    for (int64_t k = i - window / 2; k < i - window / 2 + window; k++) mean += views[k < 0 ? 0 : k >= n ? n - 1 : k];
    if (!(views[i] > 0 && mean / (double)window > g->shown_share)) continue;
    if (first >= 0 && i - last > longest_gap) {
      if (sum > most) most = sum, *start = first, *stop = last + 1;
      first = -1;
    }
    if (first < 0) first = i, last = i - 1, sum = 0;
    for (int64_t k = last + 1; k <= i; k++) sum += views[k];
    last = i;
  }
  if (first >= 0 && sum > most) most = sum, *start = first, *stop = last + 1;
  return first >= 0;
}

/* Whether anything beyond the ends of a curve (n, 3), wherever it bends to, looks like a needle at all: 1, 0, or why it
   cannot be said, less 100. */
static int anything_beyond(const Grow *g, const Eye *eyes, const double *points, int64_t n, const int64_t *look) {
  int64_t even, more = (int64_t)rint(g->farthest_mm / g->spacing_mm), most = 0;
  double *middle = evenly(points, n, g->spacing_mm, 0, &even);
  if (!middle) return NO_MEMORY - 100;
  double *back = TAKE(double, 3 * even), *beyond = TAKE(double, 3 * more), *local = TAKE(double, 3 * more);
  int64_t *width = TAKE(int64_t, more);
  Told t;
  if (!width) return NO_MEMORY - 100;
  Axis axis = g->growing->axis;
  int64_t row = (look[2] * g->growing->looks.blurs + look[1]) * g->growing->looks.widths;
  axis.banks = g->growing->banks + row, axis.none_bank = g->growing->none_banks[look[1]];
  axis.half_width = look[0], axis.lively = 0;
  if (room_to_tell(&axis, more, &t)) return NO_MEMORY - 100;
  for (int64_t i = 0; i < more; i++) width[i] = look[0];
  turned(middle, even, back);
  for (int side = 0; side < 2; side++) {
    go_on(side ? back : middle, even, more, g->spacing_mm, g->parabola_mm, beyond);
    for (int v = 0; v < 2; v++) {
      posed(eyes[v].posed, beyond, more, local);
      int failed = cut_across(&axis, eyes + v, local, more, &t);
      if (!failed) failed = weigh(&axis, more, width, STAYED, &t);
      if (failed) return failed - 100;
      int64_t seen = 0;
      for (int64_t i = 0; i < more; i++) seen += t.inside[i] && t.most[i] > g->shown_log_odds;
      most = seen > most ? seen : most;
    }
  }
  return (double)most * g->spacing_mm > g->goes_on_mm;
}

static int grown(const Grow *g, const Eye *eyes, Grown *o) {
  int64_t count, remaining = g->rounds, reach = 0;
  double *part = TAKE(double, 3 * o->room), length_mm = 0;
  if (!part) return NO_MEMORY;
  size_t kept = taken();
  double *points = evenly(g->points_mm, g->n, g->spacing_mm, 0, &count);
  if (!points) return NO_MEMORY;
  Adjust now = *g->rough;
  memcpy(now.near, g->near, sizeof now.near);
  for (;;) {
    Adjusted found;
    remaining--;
    now.points_mm = points, now.n = count;
    if (room_to_adjust(count, &found)) return NO_MEMORY;
    int failed = adjusted(&now, eyes, &found);
    if (failed) return failed;
    int64_t start, stop;
    if (!shown(g, found.support, count, &start, &stop)) return NOT_SEEN;
    /* What became longer than any needle is none. */
    if (stop - start > o->room) return TOO_LONG;
    o->count = stop - start;
    memcpy(part, found.points_mm + 3 * start, (size_t)(3 * o->count) * sizeof *part);
    memcpy(o->look, found.look, sizeof o->look);
    give_back(kept);
    double grown_mm = (double)(o->count - 1) * g->spacing_mm - length_mm;
    length_mm += grown_mm;
    if (length_mm > g->longest_mm) return TOO_LONG;
    /* What grows no more may bend more than was foreseen, or go on behind a gap. */
    double least_mm = g->settled_mm < g->reaches_mm[reach] / 2 ? g->settled_mm : g->reaches_mm[reach] / 2;
    reach = grown_mm > least_mm ? 0 : reach + 1;
    if (remaining == 0 || reach == g->reaches) break;
    if (reach > 0) {
      int more = anything_beyond(g, eyes, part, o->count, o->look);
      if (more < 0) return more + 100;
      give_back(kept);
      if (!more) break;
    }
    points = lengthened(g, part, o->count, g->reaches_mm[reach], &count);
    if (!points) return NO_MEMORY;
    now = *g->growing;
    memcpy(now.near, o->look, sizeof now.near);
  }
  if (length_mm < g->shortest_mm) return TOO_SHORT;
  memcpy(o->points_mm, part, (size_t)(3 * o->count) * sizeof *part);
  return FOUND;
}

typedef struct {
  const Grow *wanted;
  const Eye *eyes;
  Grown *found;
} Call;

static int once(void *what) {
  Call *call = what;
  return grown(call->wanted, call->eyes, call->found);
}

/* See `grow.grow`. Returns BANK_WANTED where banks have to be made first: those that are marked. */
EXPORT int grow(const Grow *g, const Eye *eyes, Grown *o) {
  Call call = {g, eyes, o};
  return with_memory(once, &call);
}
