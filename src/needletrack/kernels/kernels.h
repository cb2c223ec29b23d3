/* What the kernels share: the camera's layout, and mathematics that a compiler can vectorise. */
#ifndef NEEDLETRACK_KERNELS_H
#define NEEDLETRACK_KERNELS_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

/* Control points of a spline at most. */
#define MOST_CONTROL 30

/* As `needletrack.kernels.Lens` lays it out: all doubles. camera_from_world = [rotation | translation_mm]. */
typedef struct {
  double fx, fy, cx, cy, skew;
  double k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4;
  double tilt[9];
  double rotation[9], translation_mm[3];
} Camera;

/* Raw pixel of a ray (x, y, 1) in the camera's frame; by_ray, if wanted: its derivatives (2, 2). */
void distorted(const Camera *c, double x, double y, double *px, double *by_ray);
/* The ray (x, y, 1) of a raw pixel. */
void ray_of(const Camera *c, const double *px, double *ray);

/* What one view measures; as `fit._Sight` lays it out. Undistorted px. Outputs are marked. */
typedef struct {
  const Camera *camera;
  const double *here_px, *ahead;          /* (n, 2) where each section was taken, and a raw pixel along it */
  const double *offset_px, *sigma_px;     /* (n,) of the axis along it; infinite where not seen */
  int64_t ends;                           /* ends that the view shows, at points end_index (ends,) */
  const int64_t *end_index;
  const double *end_here_px, *end_ahead, *end_sigma_px; /* (ends, 2), (ends, 2), (ends,) */
  int64_t lines;                          /* sections line_index (lines,) that show a streak at line_offset_px */
  const int64_t *line_index;
  const double *line_offset_px;
  double *line_weighted, *line_normal;    /* (lines, 3 m) and (3 m, 3 m) of `streak_line` */
  int64_t count;                          /* out: how many of the following, which have room for n + ends */
  int64_t *index;                         /* out: their points */
  double *residual, *rows, *weight, *sigma; /* out: offsets of the start, (12,) each, robust weights, sigmas */
} Sight;

/* One view of an end, and the pictures of each shape of end that is tried; as `tip._TipView` lays it out. */
typedef struct {
  const double *weight, *weighted, *fixed; /* (n, width), (n, width, 8), (8, 8) of `tip_picture` */
  double noise_gray;
  int64_t parts;
  const double *pictures[8], *own[8];      /* (distances, parts, width) of each shape, and of `pictures_of` ... */
  const uint8_t *extent[8];                /* ... (distances, parts, parts) and (distances, parts, 2) */
  int64_t distances[8];
  double before_mm[8];
} TipView;

/* e^x of single precision for x <= 0, to 1e-5 of itself; below -87 it is nearly 0. */
static inline float exp_negative(float x) {
  x = x < -87.0f ? -87.0f : x;
  float n = rintf(x * 1.44269504f);
  float r = x - n * 0.693147181f;
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * r * r + r + 1.0f;
  int32_t power = ((int32_t)n + 127) << 23;
  float two;
  memcpy(&two, &power, sizeof two);
  return p * two;
}

/* e^x of double precision for -700 < x <= 0, to 1e-13 of itself (Taylor's series on half of log 2 to either side). */
static inline double exp_negative_precise(double x) {
  x = x < -700 ? -700 : x;
  double n = rint(x * 1.4426950408889634);
  double r = x - n * 6.931471805599453094e-1;
  double p = 1.0 / 479001600;
  p = p * r + 1.0 / 39916800;
  p = p * r + 1.0 / 3628800;
  p = p * r + 1.0 / 362880;
  p = p * r + 1.0 / 40320;
  p = p * r + 1.0 / 5040;
  p = p * r + 1.0 / 720;
  p = p * r + 1.0 / 120;
  p = p * r + 1.0 / 24;
  p = p * r + 1.0 / 6;
  p = p * r + 0.5;
  p = p * r * r + r + 1.0;
  int64_t power = (int64_t)((int32_t)n + 1023) << 52;
  double two;
  memcpy(&two, &power, sizeof two);
  return p * two;
}

/* Share of a normal distribution beyond t >= 0 over e^(-t^2 / 2), to 1e-13 of itself where that counts, up to t = 7 (Hart
   1968, Computer Approximations, 5666); it goes to 0 as it should beyond. */
static inline double tail(double t) {
  double above = 3.52624965998911e-2, below = 8.83883476483184e-2;
  above = above * t + 0.700383064443688, below = below * t + 1.75566716318264;
  above = above * t + 6.37396220353165, below = below * t + 16.064177579207;
  above = above * t + 33.912866078383, below = below * t + 86.7807322029461;
  above = above * t + 112.079291497871, below = below * t + 296.564248779674;
  above = above * t + 221.213596169931, below = below * t + 637.333633378831;
  above = above * t + 220.206867912376, below = below * t + 793.826512519948;
  below = below * t + 440.413735824752;
  return above / below;
}

/* Share of a normal distribution below z. */
static inline double normal_share(double z) {
  double t = fabs(z), beyond = exp_negative_precise(-0.5 * t * t) * tail(t);
  return z > 0 ? 1 - beyond : beyond;
}

/* log(1 + e^-d) of single precision for d >= 0, to 1e-6. */
static inline float log_one_plus_exp_negative(float d) {
  float e = exp_negative(-d);
  /* log1p(e) on [0, 1]: atanh series in e / (2 + e), at most 1/3. */
  float z = e / (2.0f + e), z2 = z * z;
  float p = 1.0f / 13.0f;
  p = p * z2 + 1.0f / 11.0f;
  p = p * z2 + 1.0f / 9.0f;
  p = p * z2 + 1.0f / 7.0f;
  p = p * z2 + 1.0f / 5.0f;
  p = p * z2 + 1.0f / 3.0f;
  return 2.0f * z * (p * z2 + 1.0f);
}

/* The kernels themselves; each says beside its body what it does. */
#define MOST_DEGREE 3
int polynomial(const double *at, const double *values, int64_t n, int64_t d, int degree, double *terms);
int parabola(const double *at, const double *values, int64_t n, int64_t d, double *terms);
void project(const Camera *c, const double *points_mm, int64_t n, double *pixels);
void straighten(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *c,
                const double *local_mm, int64_t n, const double *offsets, int64_t count, double unit_mm, double *px,
                double *normal, float *gray);
double noise(const float *strip, int64_t n, int64_t count, float *work);
float selected(float *v, int64_t n, int64_t k);
void cut_sections(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *c,
                  const double *local_mm, int64_t n, int64_t per, const double *offsets, int64_t count, double unit_mm,
                  double least_gray, double per_noise, double *work, double *center, double *normal, double *values,
                  double *px_per_unit, uint8_t *inside);
void products(const double *sections, int64_t n, int64_t count, const double *whitener, float *out);
int64_t features(int64_t count);
int64_t columns_of(int64_t p);
void by_background(const float *shown, int64_t n, int64_t count, const float *bank, int64_t places, int64_t p, float *out,
                   float *work);
void no_needle(const float *shown, int64_t n, int64_t count, const float *bank, int64_t p, double *out, float *work);
void over_none(const float *both, const double *none, int64_t n, int64_t s, double *log, uint8_t *cluttered);
void prepared(const double *log, int64_t n, int64_t s, const float *refine, int64_t f, double never, float outlier,
              double *most, float *relative, float *likelihood);
void sites(const double *most, const float *relative, const float *likelihood, int64_t n, double low, double step,
           int64_t s, double fine_step, int64_t f, const double *expected_px, double spread, const double *px_per_unit,
           const uint8_t *inside, const uint8_t *doubtful, double least_gain, double least_sigma, double used,
           double clutter_factor, double *offset_px, double *sigma_px, double *support);
void best_path(double *worth, int64_t n, int64_t s, double price, int64_t *path);
void best_motion(const double *log, int64_t n, int64_t s, const double *drifts, int64_t d, double step,
                 double motion_price, double floor_log, double *shift);
void basis(const double *u, int64_t n, int64_t m, int64_t derivative, int64_t *first, double *mixing);
void curve(const double *control, const int64_t *first, const double *mixing, int64_t n, double *points);
int approach(Sight *sights, int64_t n, int64_t m, const int64_t *first, const double *mixing, const double *start,
             double *control, const double *held, const double *smooth, double share, double robust_px, int64_t rounds,
             double *normal, double *work);
int fit_covariance(const Sight *sights, int64_t n, int64_t m, const int64_t *first, const double *start,
                   const double *control, const double *normal, const double *length_mm, const double *systematic,
                   double systematic_mm, double *residual_px, double *rms_px, double *covariance, double *work);
int streak_line(const Sight *s, const double *points, const int64_t *first, const double *mixing, int64_t m,
                const double *at_mm, const double *along, const double *variance, double radius_px,
                const double *shares, double change_mm, double robust, double *expected, double *work);
double streak_misfit(const Sight *s, const double *points, const double *expected, double *work);
int start_of_fit(const double *points, const double *length_mm, int64_t n, int64_t m, const int64_t *first,
                 const double *mixing, const double *priors, double bent_for_s, double *start, double *held,
                 double *smooth, double *work);
int64_t find_streak(const double *values, int64_t n, int64_t count, const double *line, int64_t length, double low,
                    double step, const double *half_widths, const double *axis, const double *rules, double *offset,
                    double *sigma, double *work);
double tip_picture(const uint8_t *image, int64_t rows, int64_t columns, int64_t stride, const Camera *c,
                   const double *local_mm, const double *arc_mm, int64_t n, const double *across, int64_t width,
                   double unit_mm, double reach, const double *rules, double *gray, double *weight, double *weighted,
                   double *fixed, double *noise_gray, double *work);
int find_tip(const TipView *views, int64_t shapes, const double *arc_mm, int64_t n, int64_t width, double picture_mm,
             const double *prior, double log_prior, double end_mm, const double *rules, double *out, double *work);

#endif
