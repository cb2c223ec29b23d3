/* Thin structures of an image that was reduced: how strongly each pixel answers, which hang together, their skeletons. */
#include "kernels.h"

/* The image reduced k times: rows x columns means of k x k pixels, rounded to whole grey levels. */
EXPORT void reduce(const uint8_t *image, int64_t stride, int64_t k, int64_t rows, int64_t columns, uint16_t *sums,
                   float *reduced) {
  int64_t width = columns * k;
  float share = 1.0f / (float)(k * k);
  for (int64_t r = 0; r < rows; r++) {
    const uint8_t *row = image + r * k * stride;
    for (int64_t x = 0; x < width; x++) sums[x] = row[x];
    for (int64_t i = 1; i < k; i++) {
      row += stride;
      for (int64_t x = 0; x < width; x++) sums[x] = (uint16_t)(sums[x] + row[x]);
    }
    for (int64_t c = 0; c < columns; c++) {
      uint32_t sum = 0;
      for (int64_t i = 0; i < k; i++) sum += sums[c * k + i];
      reduced[r * columns + c] = floorf((float)sum * share + 0.5f);
    }
  }
}

static inline void answer(float left, float here, float right, float up, float down, float corners, float scale,
                          float *bright, float *dark) {
  float xx = scale * (left - 2 * here + right), yy = scale * (up - 2 * here + down), xy = 0.25f * scale * corners;
  /* The eigenvalues of the Hessian are mean -+ spread. A line curves across and hardly along: the stronger one is more
     than twice the other, which is |mean| between a third of the spread and three times it. */
  float mean = 0.5f * (xx + yy), difference = 0.5f * (xx - yy);
  float spread = sqrtf(difference * difference + xy * xy), size = fabsf(mean);
  float strength = (3 * size > spread) & (size < 3 * spread) ? size + spread : 0.0f;
  *bright = mean < 0 ? strength : 0.0f;
  *dark = mean > 0 ? strength : 0.0f;
}

/* How strongly each pixel of an image blurred by sigma answers to bright and to dark lines; scale: sigma squared. */
EXPORT void line_answers(const float *blurred, int64_t rows, int64_t columns, double squared, float *bright,
                         float *dark) {
  float scale = (float)squared;
  for (int64_t r = 0; r < rows; r++) {
    const float *here = blurred + r * columns;
    const float *up = r > 0 ? here - columns : here, *down = r + 1 < rows ? here + columns : here;
    float *b = bright + r * columns, *d = dark + r * columns;
    for (int64_t c = 1; c < columns - 1; c++)
      answer(here[c - 1], here[c], here[c + 1], up[c], down[c], up[c - 1] - up[c + 1] - down[c - 1] + down[c + 1],
             scale, b + c, d + c);
    for (int64_t c = 0; c < columns; c += columns > 1 ? columns - 1 : 1) {
      int64_t before = c > 0 ? c - 1 : 0, after = c + 1 < columns ? c + 1 : c;
      answer(here[before], here[c], here[after], up[c], down[c], up[before] - up[after] - down[before] + down[after],
             scale, b + c, d + c);
    }
  }
}

/* Raise a response (n,) to the lines of this scale that exceed a share of the other polarity's nearby, the most of it. */
EXPORT void add_lines(const float *lines, const float *others, double share, int64_t n, float *response) {
  float least = (float)share;
  for (int64_t i = 0; i < n; i++) {
    float line = lines[i] > least * others[i] ? lines[i] : 0.0f;
    response[i] = response[i] > line ? response[i] : line;
  }
}

/* What exceeds low and hangs together, by eight neighbours, with something above high; the outermost pixels hold 0. */
EXPORT void hysteresis(const float *response, int64_t rows, int64_t columns, double low, double high, int32_t *stack,
                       uint8_t *mask) {
  const int64_t beside[8] = {-columns - 1, -columns, 1 - columns, -1, 1, columns - 1, columns, columns + 1};
  float least = (float)low, start = (float)high;
  memset(mask, 0, (size_t)(rows * columns));
  for (int64_t i = 0; i < rows * columns; i++) {
    if (!(response[i] > start) || mask[i]) continue;
    int64_t depth = 0;
    mask[i] = 1;
    stack[depth++] = (int32_t)i;
    while (depth) {
      int64_t at = stack[--depth];
      for (int k = 0; k < 8; k++) {
        int64_t next = at + beside[k];
        if (!mask[next] && response[next] > least) mask[next] = 1, stack[depth++] = (int32_t)next;
      }
    }
  }
}

/* In which passes thinning takes away a pixel with these neighbours, clockwise from above: first (1), second (2), both.
   Zhang & Suen 1984, but for two things. Lines two pixels wide would wear away from their ends and corners: what holds
   on by few pixels goes in one pass alone. And corners of a staircase go, the upper ones first, so that no pixel of an
   unbranched line has more than two neighbours. */
static uint8_t passes(unsigned n) {
  int p[8], runs = 0, count = 0;
  for (int k = 0; k < 8; k++) p[k] = n >> k & 1;
  for (int k = 0; k < 8; k++) runs += !p[k] && p[(k + 1) % 8], count += p[k];
  if (count < 2 || count > 6) return 0;
  int up = p[0], right = p[2], down = p[4], left = p[6];
  if (runs == 2) {
    for (int k = 0; k < 8; k += 2)
      /* Two sides meet at a pixel that is not set; opposite there is nothing. */
      if (p[k] && p[(k + 2) % 8] && !p[(k + 1) % 8] && !p[(k + 4) % 8] && !p[(k + 5) % 8] && !p[(k + 6) % 8])
        return count == 2 ? 3 : up ? 1 : 2;
    return 0;
  }
  if (runs != 1) return 0;
  if (count == 2 || (count == 3 && up + right + down + left == 2)) return up || (right && p[1]) || (left && p[7]) ? 1 : 2;
  int first = !(up && right && down) && !(right && down && left), second = !(up && right && left) && !(up && down && left);
  return (uint8_t)(first | second << 1);
}

static inline unsigned neighbours(const uint8_t *on, int64_t w) {
  return (unsigned)(on[-w] | on[1 - w] << 1 | on[1] << 2 | on[w + 1] << 3 | on[w] << 4 | on[w - 1] << 5 | on[-1] << 6 |
                    on[-w - 1] << 7);
}

/* Unbranched stretches of a mask's skeleton, in order from one end: pixels (x, y) one stretch behind the other, and how
   many stretches; ends: where each stops. on (rows + 2, columns + 2), list (2, rows * columns) are for its own use. */
EXPORT int32_t skeleton_pieces(const uint8_t *mask, int64_t rows, int64_t columns, int64_t shortest, uint8_t *on,
                               int32_t *list, double *points, int64_t *ends) {
  int64_t w = columns + 2, count = 0;
  int32_t *other = list + rows * columns;
  memset(on, 0, (size_t)((rows + 2) * w));
  for (int64_t r = 0; r < rows; r++)
    for (int64_t c = 0; c < columns; c++)
      if (mask[r * columns + c]) {
        int64_t at = (r + 1) * w + c + 1;
        on[at] = 1;
        list[count++] = (int32_t)at;
      }
  uint8_t table[256];
  for (unsigned n = 0; n < 256; n++) table[n] = passes(n);
  for (int64_t quiet = 0, pass = 1; quiet < 2; pass = 3 - pass) {
    int64_t gone = 0, kept = 0;
    for (int64_t i = 0; i < count; i++) {
      int32_t at = list[i];
      if (table[neighbours(on + at, w)] & pass)
        other[gone++] = at;
      else
        list[kept++] = at;
    }
    for (int64_t i = 0; i < gone; i++) on[other[i]] = 0;
    count = kept;
    quiet = gone ? 0 : quiet + 1;
  }
  /* Without the pixels at which lines meet, and those beside them, no pixel has more than two neighbours. */
  int64_t open = 0;
  for (int64_t i = 0; i < count; i++)
    other[i] = __builtin_popcount(neighbours(on + list[i], w)) > 2;
  for (int64_t i = 0; i < count; i++)
    if (other[i])
      for (int64_t dy = -w; dy <= w; dy += w)
        for (int64_t dx = -1; dx <= 1; dx++) on[list[i] + dy + dx] = 0;
  for (int64_t i = 0; i < count; i++)
    if (on[list[i]]) list[open++] = list[i];
  /* Straight steps before diagonal ones, so that a corner of the staircase is not jumped. */
  const int64_t steps[8] = {1, -1, w, -w, w + 1, w - 1, 1 - w, -1 - w};
  int64_t pieces = 0, length = 0;
  for (int64_t i = 0; i < open; i++) {
    if (on[list[i]] != 1) continue;
    /* All of the stretch, and the first of its pixels with the fewest neighbours: an end, if it has one. */
    int64_t found = 0;
    other[found++] = list[i];
    on[list[i]] = 2;
    int32_t start = 0;
    int fewest = 9;
    for (int64_t j = 0; j < found; j++) {
      int beside = 0;
      for (int k = 0; k < 8; k++) {
        int32_t next = other[j] + (int32_t)steps[k];
        if (!on[next]) continue;
        beside++;
        if (on[next] == 1) on[next] = 2, other[found++] = next;
      }
      if (beside < fewest || (beside == fewest && other[j] < start)) fewest = beside, start = other[j];
    }
    if (found < shortest) continue;
    for (int64_t at = start, goes_on = 1; goes_on;) {
      on[at] = 3;
      points[2 * length] = (double)(at % w - 1), points[2 * length + 1] = (double)(at / w - 1);
      length++;
      goes_on = 0;
      for (int k = 0; k < 8; k++)
        if (on[at + steps[k]] == 2) {
          at += steps[k];
          goes_on = 1;
          break;
        }
    }
    ends[pieces++] = length;
  }
  return (int32_t)pieces;
}

static inline float level(const float *image, int64_t rows, int64_t columns, float x, float y) {
  x = x < 0 ? 0 : x > (float)(columns - 1) ? (float)(columns - 1) : x;
  y = y < 0 ? 0 : y > (float)(rows - 1) ? (float)(rows - 1) : y;
  int32_t c = (int32_t)x, r = (int32_t)y;
  float fx = x - (float)c, fy = y - (float)r;
  const float *at = image + r * columns + c, *below = r + 1 < rows ? at + columns : at;
  int32_t next = c + 1 < columns;
  float above = at[0] + fx * (at[next] - at[0]);
  return above + fy * (below[0] + fx * (below[next] - below[0]) - above);
}

/* By how much a point of a line of this direction differs from both its sides within `count` steps of so many pixels
   across, and how wide it is: up to where either side differs half as much as it ever does. */
static void look_beside(const float *image, int64_t rows, int64_t columns, const double *point, double along_x,
                        double along_y, double step, int64_t count, float *difference, double *contrast, double *width) {
  float x = (float)point[0], y = (float)point[1];
  float here = level(image, rows, columns, x, y), brightest[2], darkest[2];
  int64_t within = 0;
  for (int side = 0; side < 2; side++) {
    float dx = (float)((side ? -step : step) * along_y), dy = (float)((side ? step : -step) * along_x);
    float most = -INFINITY, least = INFINITY;
    for (int64_t k = 0; k < count; k++) {
      float d = level(image, rows, columns, x + (float)(k + 1) * dx, y + (float)(k + 1) * dy) - here;
      most = d > most ? d : most;
      least = d < least ? d : least;
      difference[k] = fabsf(d);
    }
    brightest[side] = most, darkest[side] = -least;
    float half = (most > -least ? most : -least) / 2;
    int64_t k = 0;
    while (k < count && difference[k] < half) k++;
    within += k < count ? k : 0;
  }
  float bright = brightest[0] < brightest[1] ? brightest[0] : brightest[1];
  float dark = darkest[0] < darkest[1] ? darkest[0] : darkest[1];
  *contrast = bright > dark ? bright : dark;
  *width = step * (double)(within + 1);
}

static inline int64_t held(int64_t i, int64_t n) { return i < 0 ? 0 : i >= n ? n - 1 : i; }

/* The median of values (n,) about the i-th, as far as four to either side. */
static double median_of_nine(const double *values, int64_t i, int64_t n) {
  double sorted[9];
  for (int64_t k = 0; k < 9; k++) {
    double value = values[held(i + k - 4, n)];
    int64_t j = k;
    for (; j > 0 && sorted[j - 1] > value; j--) sorted[j] = sorted[j - 1];
    sorted[j] = value;
  }
  return sorted[4];
}

/* What a stretch must be: so many steps of so many pixels are looked at across it, `corner` points to either side tell
   how much it turns. */
typedef struct {
  double step, max_width, min_contrast, max_turn_rad;
  int64_t steps, corner, shortest;
} TwoSided;

/* The stretches of pieces of skeleton, pixels one piece behind the other up to ends (count,), that are thin, differ from
   both their sides and have no corners: starts and stops among points (n, 2), which are smoothed, and widths (n,). How
   many. across (steps,), contrast (n,) are for its own use. */
EXPORT int32_t two_sided(const float *image, int64_t rows, int64_t columns, const double *pixels, const int64_t *ends,
                         int64_t count, const TwoSided *wanted, float *across, double *contrast, double *points,
                         double *width, int64_t *starts, int64_t *stops) {
  int64_t found = 0, reach = wanted->corner;
  for (int64_t piece = 0; piece < count; piece++) {
    int64_t first = piece ? ends[piece - 1] : 0, n = ends[piece] - first, begun = -1;
    const double *raw = pixels + 2 * first;
    double *p = points + 2 * first, *w = width + first, *c = contrast + first;
    for (int64_t i = 0; i < n; i++)
      for (int d = 0; d < 2; d++) {
        double sum = 0;
        for (int64_t k = -2; k <= 2; k++) sum += raw[2 * held(i + k, n) + d];
        p[2 * i + d] = sum / 5;
      }
    for (int64_t i = 0; i < n; i++) {
      const double *before = p + 2 * held(i - 1, n), *after = p + 2 * held(i + 1, n);
      double x = after[0] - before[0], y = after[1] - before[1], length = fmax(sqrt(x * x + y * y), 1e-300);
      look_beside(image, rows, columns, p + 2 * i, x / length, y / length, wanted->step, wanted->steps, across, c + i,
                  w + i);
    }
    for (int64_t i = 0; i <= n; i++) {
      int good = i < n;
      if (good) {
        double sum = 0;
        for (int64_t k = -2; k <= 2; k++) sum += c[held(i + k, n)];
        good = sum / 5 > wanted->min_contrast && median_of_nine(w, i, n) <= wanted->max_width;
      }
      if (good && i >= reach && i < n - reach) {
        const double *before = p + 2 * (i - reach), *here = p + 2 * i, *after = p + 2 * (i + reach);
        double ax = here[0] - before[0], ay = here[1] - before[1], bx = after[0] - here[0], by = after[1] - here[1];
        good = fabs(atan2(ax * by - ay * bx, ax * bx + ay * by)) < wanted->max_turn_rad;
      }
      if (good && begun < 0) begun = i;
      if (!good && begun >= 0) {
        if (i - begun >= wanted->shortest) starts[found] = first + begun, stops[found++] = first + i;
        begun = -1;
      }
    }
  }
  return (int32_t)found;
}
