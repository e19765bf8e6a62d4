// How much an image has changed: the largest mean over a window, in fixed point.

#include <math.h>
#include <string.h>

#include "image.h"

// a change of 1 in fixed point: the sum over a window of 129 x 129 fits 31 bits
#define ONE 65536.0f

// a float of 32 bits and its bits; those of 1
typedef union {
  float value;
  int32_t bits;
} Bits;
enum { ONE_BITS = 0x3f800000 };


size_t change_scratch(int cols, int window) {
  return 2 * (size_t)cols + (size_t)window;
}


// index within 0 .. n - 1, mirrored at the first and the last
static int mirrored(int i, int n) {
  while (i < 0 || i >= n) {
    i = i < 0 ? -i : 2 * (n - 1) - i;
    i = n == 1 ? 0 : i;
  }
  return i;
}


// sums += sign * change beyond the noise
WIDE_VECTORS
static void add_changes(int32_t* restrict sums, const float* restrict image,
                        const float* restrict reference, const float* restrict noise, int32_t sign,
                        int n) {
  for (int x = 0; x < n; x++) {
    Bits change = {.value = fabsf(image[x] - reference[x]) - noise[x]};
    // within 0 and 1, so that it fits: as integers, floats have the same order and NaN is the
    // largest
    change.bits = change.bits > 0 ? change.bits : 0;
    change.bits = change.bits < ONE_BITS ? change.bits : ONE_BITS;
    sums[x] += sign * (int32_t)(change.value * ONE + 0.5f);
  }
}


// largest sum of `window` neighbors, the first of them `before` columns to the left
static uint32_t largest_sum(const int32_t* sums, int cols, int window, int before,
                            uint32_t* total) {
  uint32_t sum = 0;
  *total++ = 0;
  for (int x = -before; x < 0; x++) { *total++ = sum += (uint32_t)sums[mirrored(x, cols)]; }
  for (int x = 0; x < cols; x++) { *total++ = sum += (uint32_t)sums[x]; }
  for (int x = cols; x < cols + window - 1 - before; x++) {
    *total++ = sum += (uint32_t)sums[mirrored(x, cols)];
  }
  total -= cols + window;
  // the totals may wrap around, their differences do not
  uint32_t res = 0;
  for (int x = 0; x < cols; x++) {
    sum = total[x + window] - total[x];
    res = sum > res ? sum : res;
  }
  return res;
}


double largest_change(const float* image, const float* reference, const float* noise, int rows,
                      int cols, int window, uint32_t* scratch) {
  int32_t* sums = (int32_t*)scratch;
  uint32_t *total = scratch + cols, largest = 0;
  int before = window / 2, after = window - 1 - before;
  memset(sums, 0, (size_t)cols * sizeof(int32_t));
  for (int y = -before; y < after; y++) {
    ptrdiff_t start = (ptrdiff_t)mirrored(y, rows) * cols;
    add_changes(sums, image + start, reference + start, noise + start, 1, cols);
  }
  for (int y = 0; y < rows; y++) {
    ptrdiff_t gained = (ptrdiff_t)mirrored(y + after, rows) * cols;
    ptrdiff_t lost = (ptrdiff_t)mirrored(y - before, rows) * cols;
    add_changes(sums, image + gained, reference + gained, noise + gained, 1, cols);
    uint32_t sum = largest_sum(sums, cols, window, before, total);
    largest = sum > largest ? sum : largest;
    add_changes(sums, image + lost, reference + lost, noise + lost, -1, cols);
  }
  return largest / ((double)window * window * ONE);
}
