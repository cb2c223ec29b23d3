/* A curve that is nearly right, adjusted to both silhouettes: see `tracking/adjust.py`. */
#ifndef NEEDLETRACK_ADJUST_H
#define NEEDLETRACK_ADJUST_H

#include "curve.h"

enum { BANK_WANTED = OTHERS, OTHERS_STILL };

/* What a needle may look like, and how sections tell; as `adjust._Looked` lays it out. */
typedef struct {
  /* (2, blurs, widths): where the bank of each look lies, 0 where there is none yet; wanted: the same, marked where one
     was asked for in vain. */
  const float *const *banks;
  uint8_t *wanted;
  int64_t blurs, widths, first_width, last_width, samples, places, reached;
  const double *blur_units;
  double blur_low_px, blur_high_px;
  double most_say, lively_share, lively_say, dull_say;
} Looks;

/* What is known and wanted; as `adjust._Adjust` lays it out. */
typedef struct {
  Axis axis;
  Spline spline;
  Looks looks;
  /* Banks of the grid of the axis, as those of the looks; of no needle, by blur; and how much either inside is pulled. */
  const float *const *banks, *const *none_banks;
  uint8_t *wanted;
  const double *systematic_px;
  int64_t deciding, lively_inside;
  double white_share;
  int64_t expectation, with_streak, with_covariance;
  /* The curve (n, 3); half width, blur, inside of the needle before, -1: not known; whether they are so still. */
  const double *points_mm;
  int64_t n, near[3], looks_the_same;
  /* Distances (n,) from the apex of a tip that tapers over taper_mm, or null. */
  const double *before_tip_mm;
  double taper_mm, bent_for_s;
  /* For each view: at which point it shows the end, if it does, how far ahead, and how well. */
  int64_t end_index[2];
  double end_shift_px[2], end_sigma_px[2];
} Adjust;

/* What was found, of n points in 2 views; room for MOST_CONTROL control points. */
typedef struct {
  double *control_mm, *covariance_mm2, *parameters, *points_mm, *residual_px, *center_px, *normal, *offset_px, *sigma_px,
      *support, *expected_px, *streak_px, *streak_sigma_px, *px_per_unit;
  uint8_t *shines;
  int64_t control_count, look[3];
  double rms_px, streak_misfit, white_shares[2];
} Adjusted;

/* Room for what is found of n points; 1 where there is none. */
int room_to_adjust(int64_t n, Adjusted *o);
/* The curve adjusted; BANK_WANTED where banks have to be made first: those that are marked. */
int adjusted(const Adjust *wanted, const Eye *eyes, Adjusted *o);

#endif
