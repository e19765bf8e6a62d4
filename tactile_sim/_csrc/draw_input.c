// A network's input drawn directly (see draw_input.h).
//
// A white pixel is one above the mean of its neighborhood. That mean changes so little from one
// cell to the next that the cells' own gray levels give it; and it says at which radius a disc's
// edge is cut. So each disc is drawn once for the means and once, with that radius, into the input.
// Beyond the discs the ground is white where no disc brightens the neighborhood.

#include "draw_input.h"

#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define CLONES __attribute__((target_clones("avx2", "default")))
#else
#define CLONES
#endif

// Cells are gone through by so many at once; rows end in as many cells that are not looked at.
enum { VECTOR = 8 };


static int stride_of(const InputView* view) {
  return view->size + VECTOR;
}


static int clamp(double value, int low, int high) {
  return value < low ? low : value > high ? high : (int)value;
}


// Cells that a disc may touch, from `first` on `count` of a row; from its middle to the first.
typedef struct {
  int top, bottom, first, count;
  float x, y, width, height;
} Cells;


static Cells cells_of(const InputView* view, const double disc[4], double reach) {
  double x = (disc[0] + 0.5 - view->left) / view->width;
  double y = (disc[1] + 0.5 - view->top) / view->height;
  // a ramp as wide as a cell ends half a cell beyond
  double across = reach / view->width + 0.5, down = reach / view->height + 0.5;
  Cells cells = {clamp(ceil(y - down - 0.5), 0, view->size),
                 clamp(floor(y + down + 0.5), 0, view->size),
                 clamp(ceil(x - across - 0.5), 0, view->size),
                 0,
                 0,
                 0,
                 (float)view->width,
                 (float)view->height};
  int last = clamp(floor(x + across + 0.5), 0, view->size);
  cells.count = (last - cells.first + VECTOR - 1) / VECTOR * VECTOR;
  while (cells.count > 0 && cells.first + cells.count > stride_of(view)) { cells.count -= VECTOR; }
  cells.x = (float)((cells.first + 0.5 - x) * view->width);
  cells.y = (float)((cells.top + 0.5 - y) * view->height);
  return cells;
}


static float clamped(float value) {
  value = value > 0 ? value : 0;
  return value < 1 ? value : 1;
}


// a disc into the cells' mean gray levels
CLONES static void add_disc(float* restrict gray, int stride, Cells cells, float radius,
                            float level) {
  float scale = 1 / cells.width;
  for (int row = cells.top; row < cells.bottom; row++) {
    float y = cells.y + (float)(row - cells.top) * cells.height;
    for (int first = 0; first < cells.count; first += VECTOR) {
      float* line = gray + (size_t)row * stride + cells.first + first;
      float x = cells.x + (float)first * cells.width;
      for (int k = 0; k < VECTOR; k++) {
        float dx = x + (float)k * cells.width, distance = sqrtf(dx * dx + y * y);
        line[k] += (level - line[k]) * clamped(0.5f + (radius - distance) * scale);
      }
    }
  }
}


// where an edge that fades as 3 t^2 - 2 t^3 has this part of its height:
// t = 1/2 - sin(asin(1 - 2 part)/3), to 0.001 between 0.05 and 0.95
static float edge_at(float part) {
  float u = 1 - 2 * part, u2 = u * u;
  return 0.5f - u * (1 / 3.f + u2 * (0.05602f + u2 * (-0.01602f + u2 * 0.06807f)));
}


// One disc as it is cut: it ends `reach` from its middle where the threshold is `under`, the
// ground, and `softness` less where it is 1/scale higher, the disc's own level.
typedef struct {
  float reach, softness, under, scale;
} Edge;


// a disc into the parts of the cells that are black, cut at each cell where its threshold says
CLONES static void cut_disc(float* restrict black, const float* restrict threshold, int stride,
                            Cells cells, Edge edge) {
  float scale = 1 / cells.width;
  for (int row = cells.top; row < cells.bottom; row++) {
    float y = cells.y + (float)(row - cells.top) * cells.height;
    for (int first = 0; first < cells.count; first += VECTOR) {
      size_t start = (size_t)row * stride + (size_t)(cells.first + first);
      float* line = black + start;
      const float* cut_at = threshold + start;
      float x = cells.x + (float)first * cells.width;
      for (int k = 0; k < VECTOR; k++) {
        float dx = x + (float)k * cells.width;
        float part = clamped((cut_at[k] - edge.under) * edge.scale);
        float radius = edge.reach - edge.softness * edge_at(part);
        line[k] *= 1 - clamped(0.5f + (radius - sqrtf(dx * dx + y * y)) * scale);
      }
    }
  }
}


// mean (size rows of `stride`) = offset + means of `block` rows around each of gray; beyond the
// first and the last row come more of these. total: size + 1 rows
CLONES static void means_down(float* restrict mean, const float* restrict gray, int size,
                              int stride, float block, float offset, float* restrict total) {
  memset(total, 0, (size_t)stride * sizeof(float));
  for (int row = 0; row < size; row++) {
    const float *line = gray + (size_t)row * stride, *before = total + (size_t)row * stride;
    float* after = total + (size_t)(row + 1) * stride;
    for (int x = 0; x < stride; x++) { after[x] = before[x] + line[x]; }
  }
  for (int row = 0; row < size; row++) {
    float from = row + 0.5f - 0.5f * block, to = row + 0.5f + 0.5f * block;
    float over = from < 0 ? -from : 0, under = to > size ? to - size : 0;
    from += over;
    to -= under;
    int a = (int)from < size ? (int)from : size - 1, b = (int)to < size ? (int)to : size - 1;
    float part_a = from - a, part_b = to - b, scale = 1 / block;
    const float *first = gray, *last = gray + (size_t)(size - 1) * stride;
    const float *at_a = gray + (size_t)a * stride, *at_b = gray + (size_t)b * stride;
    const float *sum_a = total + (size_t)a * stride, *sum_b = total + (size_t)b * stride;
    float* line = mean + (size_t)row * stride;
    for (int x = 0; x < stride; x++) {
      float inside = sum_b[x] + part_b * at_b[x] - sum_a[x] - part_a * at_a[x];
      line[x] = (over * first[x] + under * last[x] + inside) * scale + offset;
    }
  }
}


// res (columns of `rows` rows) = mat (rows of `columns`), both of `stride`
static void transpose(float* restrict res, const float* restrict mat, int size, int stride) {
  for (int i = 0; i < size; i += VECTOR) {
    for (int j = 0; j < size; j++) {
      for (int k = i; k < i + VECTOR && k < size; k++) {
        res[(size_t)j * stride + k] = mat[(size_t)k * stride + j];
      }
    }
  }
}


// parts of the ground that are black: around the threshold noise decides, as a ramp of its spread
CLONES static void ground_black(float* restrict black, const float* restrict threshold,
                                const float* restrict ground, float noise, size_t count) {
  float scale = 1 / (3.4641016f * noise);
  for (size_t k = 0; k < count; k++) {
    black[k] = clamped(0.5f + (threshold[k] - ground[k]) * scale);
  }
}


CLONES static void to_bytes(uint8_t* input, const float* black, const float* mask, int size,
                            int stride) {
  for (int row = 0; row < size; row++) {
    for (int x = 0; x < size; x++) {
      float white = 1 - black[(size_t)row * stride + x];
      input[(size_t)row * size + x] = (uint8_t)(255 * mask[(size_t)row * size + x] * white + 0.5f);
    }
  }
}


size_t draw_input_scratch(const InputView* view) {
  return (5 * (size_t)view->size + 1) * (size_t)stride_of(view);
}


// median and cells take as much off the radius everywhere as where the threshold is the middle's
static Edge edge_of(const InputView* view, const double disc[4], const float* ground,
                    const float* threshold) {
  int row = clamp((disc[1] - view->top) / view->height, 0, view->size - 1);
  int column = clamp((disc[0] - view->left) / view->width, 0, view->size - 1);
  size_t middle = (size_t)row * stride_of(view) + (size_t)column;
  float soft = (float)view->softness, reach = (float)disc[2] + soft / 2, under = ground[middle];
  float scale = 1 / ((float)disc[3] - under), cell = (float)(view->width * view->height / 12);
  float radius = reach - soft * edge_at(clamped((threshold[middle] - under) * scale));
  reach -= (float)view->bend / (radius * radius) + cell / (2 * radius);
  return (Edge){reach, soft, under, scale};
}


static int drawable(const double disc[4]) {
  return disc[2] > 0 && isfinite(disc[0]) && isfinite(disc[1]) && isfinite(disc[2]);
}


// the threshold of each cell from the gray levels; `turned` and `total` are scratch
static void thresholds(float* threshold, float* gray, const InputView* view, float* turned,
                       float* total) {
  int size = view->size, stride = stride_of(view);
  transpose(threshold, gray, size, stride);
  means_down(turned, threshold, size, stride, (float)(view->block / view->width), 0, total);
  transpose(gray, turned, size, stride);
  means_down(threshold, gray, size, stride, (float)(view->block / view->height), (float)view->level,
             total);
}


void draw_input(uint8_t* input, const InputView* view, const double* discs, int n,
                const float* ground, const float* mask, float* scratch) {
  int size = view->size, stride = stride_of(view);
  size_t count = (size_t)size * stride;
  float *under = scratch, *gray = under + count, *threshold = gray + count;
  float* black = threshold + count;
  double soft = view->softness, cell = view->width * view->height / 12;
  memset(under, 0, count * sizeof(float));
  for (int row = 0; row < size; row++) {
    memcpy(under + (size_t)row * stride, ground + (size_t)row * size, (size_t)size * sizeof(float));
  }
  memcpy(gray, under, count * sizeof(float));
  for (int i = 0; i < n; i++) {
    const double* disc = discs + 4 * i;
    // a soft edge holds as much as a sharp one a little further out; a ramp as wide as a cell, too
    if (!drawable(disc)) { continue; }
    double radius = fmax(disc[2] - view->bend / (disc[2] * disc[2]), 0);
    radius = sqrt(fmax(radius * radius + soft * soft / 20 - cell, 0));
    add_disc(gray, stride, cells_of(view, disc, radius), (float)radius, (float)disc[3]);
  }
  thresholds(threshold, gray, view, black, black + count);
  ground_black(black, threshold, under, (float)view->noise, count);
  for (int i = 0; i < n; i++) {
    const double* disc = discs + 4 * i;
    if (!drawable(disc)) { continue; }
    Edge edge = edge_of(view, disc, under, threshold);
    cut_disc(black, threshold, stride, cells_of(view, disc, edge.reach), edge);
  }
  to_bytes(input, black, mask, size, stride);
}
