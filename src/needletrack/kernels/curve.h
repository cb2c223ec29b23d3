/* A curve in space, seen by both views: what their sections tell, and the spline that is fitted to them. */
#ifndef NEEDLETRACK_CURVE_H
#define NEEDLETRACK_CURVE_H

#include "kernels.h"

/* Why there is no curve; whoever follows or adjusts one has further reasons, from OTHERS on. */
enum { FOUND, NOT_SEEN, NOT_HELD, NO_MEMORY, OTHERS };

/* One view; as `axis._Eye` lays it out. */
typedef struct {
  const uint8_t *image;
  int64_t rows, columns, stride;
  const Camera *own, *posed;
} Eye;

/* How sections tell the axis; as `axis.Axis` lays it out. Units are those of `tracking/evidence.py`. */
typedef struct {
  int64_t rows_per_section;
  const double *offsets;
  int64_t samples;
  double unit_mm, least_gray, per_noise;
  const double *whitener, *half_widths;
  /* Banks of the needle's look, by half width, of shifts 0 .. places - 1; and of no needle at its blur. */
  int64_t half_width;
  const float *const *banks, *none_bank;
  int64_t edges, places, fine_shifts;
  double step, fine_step;
  const float *refine;
  double never, outlier;
  /* Where the axis is. */
  const double *drifts;
  int64_t drift_count;
  double motion_price, turn_price, floor_log, least_gain, least_sigma, used, clutter_factor;
  const double *spreads;
  int64_t looks;
  /* The streak. */
  int64_t lively;
  const double *line;
  int64_t line_length;
  const double *streak_rules;
  double streak_least_share;
  double white_gray;
} Axis;

/* How a spline is fitted; as `axis.Spline` lays it out. */
typedef struct {
  double control_spacing_mm;
  const double *priors, *streak_shares;
  double streak_mm, streak_robust, correlation_mm, robust_px;
  int64_t rounds;
  double systematic_px, systematic_mm;
} Spline;

/* Where the axis is expected at first: where the curve is; on the likeliest path; where it moved to as a whole. */
enum { STAYED, PATH, MOVED };

/* One view's n sections about a curve and all that they tell. */
typedef struct {
  double *center, *normal, *values, *scale, *none, *most, *expected, *offset, *sigma, *support, *streak, *streak_sigma;
  uint8_t *inside, *cluttered, *doubtful, *shines;
  float *shown, *relative, *likelihood;
} Told;

/* A spline of m control points on its way to what both views tell of n points. */
typedef struct {
  int64_t n, m;
  const double *points, *arc;
  int64_t *first;
  double *u, *mixing, *start, *held, *smooth, *normal, *control, *work, *expected_line[2], share;
  Sight sights[2];
} Fitting;

/* Memory of this thread, given out from its start and kept from call to call: fresh pages cost more than the sums. */
void *take(size_t bytes);
size_t taken(void);
void give_back(size_t mark);
/* What `once` answers, called again where it ran out of memory. */
int with_memory(int (*once)(void *), void *what);
#define TAKE(type, count) ((type *)take((size_t)(count) * sizeof(type)))

/* Arc lengths (n,) of a polyline (n, 3). */
void lengths(const double *points, int64_t n, double *arc);
/* Points at arc lengths at_mm (count,), ascending, of a polyline (n, 3) of arc lengths (n,). */
void interpolated(const double *points, const double *arc, int64_t n, const double *at_mm, int64_t count, double *out);
/* `count` points beyond the last of (n, 3), as a parabola whose bend is that of the last stretch. */
void go_on(const double *points, int64_t n, int64_t count, double spacing, double over_mm, double *out);
/* Points (n, 3) in a camera's own frame. */
void posed(const Camera *c, const double *points, int64_t n, double *local);
/* Pixels without distortion of raw pixels, and what a raw pixel along `direction` is there. */
void undistorted(const Camera *c, const double *px, const double *direction, double *here, double *ahead);
/* The median of (n,), which is sorted into `sorted`. */
double middle_of(const double *v, int64_t n, double *sorted);
/* Share of those of n raw pixels (n, 2) in the image, of all or where `counted`, that are white. */
double white_share(const Eye *eye, const double *px, int64_t n, const uint8_t *counted, double white_gray);

/* Room for what a view tells; 1 where there is none. */
int room_to_tell(const Axis *a, int64_t n, Told *t);
/* The sections across a curve (n, 3) in the camera's frame, and their products. */
int cut_across(const Axis *a, const Eye *eye, const double *local, int64_t n, Told *t);
/* What sections of half widths (n,), as indices, -1: too thin, tell of the axis and of a streak. */
int weigh(const Axis *a, int64_t n, const int64_t *width, int expectation, Told *t);
/* What they tell of the axis where they have other half widths than they were weighed with. */
int weigh_anew(const Axis *a, int64_t n, const int64_t *width, Told *t);
/* How far off, units, n sections would rather have the axis than where it is expected, moved aside as a whole or turned;
   0 where that is likelier by no more than least_gain, log odds a section. a: on which grid. */
int likelier_elsewhere(const Axis *a, const Told *t, int64_t n, const int64_t *width, double least_gain, double *off);
/* The same sections from one of them on. */
Told told_from(const Axis *a, const Told *t, int64_t first);
/* The axis where it is expected, give or take `spread`. */
void look(const Axis *a, Told *t, int64_t n, double spread);
/* Where a curve (n, 3) leads to expect the axis; local (n, 3), px (n, 2): spare. */
void expect(const Camera *camera, Told *t, const double *points, int64_t n, double *local, double *px);
/* Begin a fit about points (n, 3) of arc lengths (n,) that bent like this so long ago; 0: it is not known how. */
int begin_fitting(const Axis *a, const Spline *s, const Eye *eyes, const Told *told, const double *points,
                  const double *arc, int64_t n, double bent_for_s, Fitting *f);
/* One or two steps of Gauss-Newton to what was looked at last. */
int come_nearer(const Spline *s, Fitting *f, int steps);
/* Look, come nearer, expect, look again: to the curve `moved` (n, 3). */
int settle(const Axis *a, const Spline *s, const Eye *eyes, Told *told, Fitting *f, double *moved);
/* Where a view's end lies, shift_px ahead of point `index`: end (7,), of which the sight keeps what it needs. */
void see_end(const Eye *eye, const Told *t, int64_t index, double shift_px, double sigma_px, double *end);
/* Covariance (3 m, 3 m) of the control points, residuals (2, n), their rms, and the streak's misfit. */
int finish_fitting(const Spline *s, Fitting *f, const double *moved, double *residual, double *rms_px, double *misfit,
                   double *covariance);

#endif
