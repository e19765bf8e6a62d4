// Area-averaging resize in integers: a target pixel is the mean over its part of the image, borders
// split exactly.

#include <string.h>

#include "image.h"


// Where the parts of the targets end, in columns and 1/size of a column.
typedef struct {
  uint32_t column, part;
} Border;


size_t shrink_scratch(int size, int cols) {
  // sums, total, borders and whole, one behind the other
  size_t n = (size_t)cols + 1;
  return 2 * n + (size_t)size * sizeof(Border) / sizeof(uint32_t) + (n + 1) / 2;
}


// sums += row
WIDE_VECTORS
static void add_row(uint16_t* restrict sums, const uint8_t* restrict row, int cols) {
  for (int x = 0; x < cols; x++) { sums[x] = (uint16_t)(sums[x] + row[x]); }
}


// sums = size * whole + weight_1 * row_1 + weight_2 * row_2
WIDE_VECTORS
static void combine(uint32_t* restrict sums, const uint16_t* restrict whole, int size,
                    const uint8_t* restrict row_1, int weight_1, const uint8_t* restrict row_2,
                    int weight_2, int cols) {
  for (int x = 0; x < cols; x++) {
    sums[x] = (uint32_t)(size * whole[x] + weight_1 * row_1[x] + weight_2 * row_2[x]);
  }
}


// Weighted sums of the rows between two borders, in 1/size of a row: a target row is rows/size rows
// high, so that all weights are integers.
static void add_rows(uint32_t* sums, uint16_t* whole, const uint8_t* image, int cols,
                     ptrdiff_t stride, int from, int to, int size) {
  int first = from / size, last = (to - 1) / size;
  memset(whole, 0, (size_t)cols * sizeof(uint16_t));
  for (int y = first + 1; y < last; y++) { add_row(whole, image + y * stride, cols); }
  // the first and the last may be cut; where they are one, size <= rows says that all of it counts
  int weight_1 = (first + 1) * size - from, weight_2 = first < last ? to - last * size : 0;
  combine(sums, whole, size, image + first * stride, weight_1, image + last * stride, weight_2,
          cols);
}


void shrink(uint8_t* res, int size, const uint8_t* image, int rows, int cols, ptrdiff_t stride,
            uint32_t* scratch) {
  uint32_t *sums = scratch, *total = sums + cols + 1;
  Border* borders = (Border*)(total + cols + 1);
  uint16_t* whole = (uint16_t*)(borders + size);
  for (int i = 0; i < size; i++) {
    int end = (i + 1) * cols;
    borders[i] = (Border){(uint32_t)(end / size), (uint32_t)(end % size)};
  }
  sums[cols] = 0;  // read with the weight 0 by the last border

  double scale = 1.0 / ((double)rows * cols);
  for (int j = 0; j < size; j++) {
    add_rows(sums, whole, image, cols, stride, j * rows, (j + 1) * rows, size);
    total[0] = 0;
    for (int x = 0; x < cols; x++) { total[x + 1] = total[x] + sums[x]; }
    // integrals up to each border; their differences are right although they wrap around
    uint32_t before = 0;
    for (int i = 0; i < size; i++) {
      uint32_t x = borders[i].column;
      uint32_t next = (uint32_t)size * total[x] + borders[i].part * sums[x];
      *res++ = (uint8_t)((next - before) * scale + 0.5);
      before = next;
    }
  }
}
