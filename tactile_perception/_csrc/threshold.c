// Adaptive threshold against the mean of a square neighborhood, without a division.
//
// With an odd area, value > round(sum / area) - offset says the same as value * area > sum - bias,
// where bias = ((2 offset - 1) area + 1) / 2.

#include <string.h>

#include "image.h"

// Loops run over multiples of a vector into padding; where there is none they do the last vector's
// worth twice.
enum { VECTOR = 32 };

// the sums over a row's neighborhoods, of as many rows as a neighborhood has and one
typedef struct {
  int cols, block, width;
  uint16_t* sums;      // (block + 1) x width
  uint16_t* piece[2];  // width + block + VECTOR: scratch
} RowSums;


static int padded(int n) {
  return (n + VECTOR - 1) / VECTOR * VECTOR;
}


size_t threshold_scratch(int cols, int block) {
  // an int32 and block + 3 sums of 16 bits for each column, and the borders of two pieces
  size_t width = (size_t)padded(cols), border = (size_t)block + VECTOR;
  return width + ((size_t)block + 3) * width / 2 + border;
}


// res = sums of four elements, `step` apart
WIDE_VECTORS
static void sum_four(uint16_t* restrict res, const uint16_t* restrict a, int step, int n) {
  for (int x = 0; x < n; x++) {
    res[x] = (uint16_t)(a[x] + a[x + step] + a[x + 2 * step] + a[x + 3 * step]);
  }
}


// res += sums of one to three elements, `step` apart
WIDE_VECTORS
static void add(uint16_t* restrict res, const uint16_t* restrict a, int step, int count, int n) {
  if (count == 1) {
    for (int x = 0; x < n; x++) { res[x] = (uint16_t)(res[x] + a[x]); }
  } else if (count == 2) {
    for (int x = 0; x < n; x++) { res[x] = (uint16_t)(res[x] + a[x] + a[x + step]); }
  } else {
    for (int x = 0; x < n; x++) {
      res[x] = (uint16_t)(res[x] + a[x] + a[x + step] + a[x + 2 * step]);
    }
  }
}


WIDE_VECTORS
static void widen(uint16_t* restrict res, const uint8_t* restrict row, int n) {
  for (int x = 0; x < n; x++) { res[x] = row[x]; }
}


static uint16_t* row_sums(const RowSums* rows, int y) {
  return rows->sums + (ptrdiff_t)(y % (rows->block + 1)) * rows->width;
}


// Sums of `block` neighbors for each column, put together from sums of 1, 4, 16 ... elements: a
// running sum would make each addition wait for the one before it.
static void add_row(const RowSums* rows, int y, const uint8_t* row) {
  int cols = rows->cols, block = rows->block, half = block / 2;
  uint16_t *piece = rows->piece[0], *longer = rows->piece[1], *res = row_sums(rows, y);
  for (int i = 0; i < half; i++) {
    piece[i] = row[0];
    piece[half + cols + i] = row[cols - 1];
  }
  widen(piece + half, row, cols);

  memset(res, 0, (size_t)rows->width * sizeof(uint16_t));
  int done = 0, n = cols + 2 * half;
  for (int length = 1;; length *= 4) {
    int count = block / length % 4;
    if (count) {
      add(res, piece + done, length, count, rows->width);
      done += count * length;
    }
    if (block < 4 * length) { break; }
    n -= 3 * length;
    sum_four(longer, piece, length, padded(n));
    uint16_t* swap = piece;
    piece = longer;
    longer = swap;
  }
}


// sums += gained - lost
WIDE_VECTORS
static void move_down(int32_t* restrict sums, const uint16_t* restrict gained,
                      const uint16_t* restrict lost, int cols) {
  for (int x = 0; x < cols; x++) { sums[x] += gained[x] - lost[x]; }
}


WIDE_VECTORS
static void compare(uint8_t* restrict res, const uint8_t* restrict row,
                    const int32_t* restrict sums, uint16_t area, const uint8_t* restrict mask,
                    int cols) {
  for (int x = 0; x < cols; x++) {
    uint32_t scaled = (uint32_t)(uint16_t)row[x] * area;
    uint8_t above = (int32_t)scaled > sums[x] ? 255 : 0;
    res[x] = above & mask[x];
  }
}


static void compare_row(uint8_t* res, const uint8_t* row, const int32_t* sums, uint16_t area,
                        const uint8_t* mask, int cols) {
  int whole = cols / VECTOR * VECTOR, rest = cols - VECTOR;
  compare(res, row, sums, area, mask, whole ? whole : cols);
  if (whole && whole < cols) {
    compare(res + rest, row + rest, sums + rest, area, mask + rest, VECTOR);
  }
}


void threshold_mean(uint8_t* res, const uint8_t* image, int rows, int cols, ptrdiff_t stride,
                    int block, int offset, const uint8_t* mask, int32_t* scratch) {
  int half = block / 2, last = rows - 1, width = padded(cols);
  int32_t* sums = scratch;
  uint16_t* memory = (uint16_t*)(scratch + width);
  uint16_t* pieces = memory + (ptrdiff_t)(block + 1) * width;
  RowSums ring = {cols, block, width, memory, {pieces, pieces + width + block + VECTOR}};

  // around row 0: what lies above the image is its first row
  int32_t bias = ((2 * offset - 1) * block * block + 1) / 2;
  for (int y = 0; y <= half && y <= last; y++) { add_row(&ring, y, image + y * stride); }
  for (int x = 0; x < width; x++) { sums[x] = (half + 1) * row_sums(&ring, 0)[x] - bias; }
  for (int y = 1; y <= half; y++) {
    const uint16_t* gained = row_sums(&ring, y < last ? y : last);
    for (int x = 0; x < width; x++) { sums[x] += gained[x]; }
  }

  for (int y = 0; y < rows; y++) {
    if (y > 0) {
      int gained = y + half, lost = y - half - 1;
      if (gained <= last) { add_row(&ring, gained, image + gained * stride); }
      move_down(sums, row_sums(&ring, gained < last ? gained : last),
                row_sums(&ring, lost > 0 ? lost : 0), width);
    }
    ptrdiff_t start = (ptrdiff_t)y * cols;
    compare_row(res + start, image + y * stride, sums, (uint16_t)(block * block), mask + start,
                cols);
  }
}
