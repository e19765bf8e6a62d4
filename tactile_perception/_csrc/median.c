// Median of 5 x 5 pixels by sorting networks that neighbors share.
//
// Each row of five is sorted once and used by the five windows it lies in; two sorted rows are
// merged once and used by four; the six middle values of two such pairs are used by two. What is
// left to a window is the median of six sorted values and a sorted row: 70 minima and maxima a
// pixel instead of about 200.

#include <string.h>

#include "image.h"

#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

// put two values in order
#define ORDER(a, b)         \
  {                         \
    uint8_t lo = MIN(a, b); \
    b = MAX(a, b);          \
    a = lo;                 \
  }

// sort five values
#define SORT5(a, b, c, d, e) \
  ORDER(a, b)                \
  ORDER(d, e) ORDER(c, e) ORDER(c, d) ORDER(b, e) ORDER(a, d) ORDER(a, c) ORDER(b, d) ORDER(b, c)

// merge sorted values (Batcher); sorted results are a0 a1 b0 b1, a0 a1 a2 b1 b0 b2
#define MERGE2(a0, a1, b0, b1) ORDER(a0, b0) ORDER(a1, b1) ORDER(a1, b0)
#define MERGE3(a0, a1, a2, b0, b1, b2) \
  MERGE2(a0, a2, b0, b2) ORDER(a1, b1) ORDER(a1, a2) ORDER(b1, b0)

// width of the strips that are worked on at once, a multiple of any vector; rows and pairs of rows
// that are kept
enum { STRIP = 256, VECTOR = 32, ROWS = 8, PAIRS = 4 };

typedef struct {
  uint8_t row[ROWS][5][STRIP];     // five neighbors, sorted
  uint8_t pair[PAIRS][10][STRIP];  // ten of two rows, sorted
} Sorted;


// copy a piece of a row that begins two pixels left of `first`, borders included
static void copy_piece(uint8_t* res, const uint8_t* row, int cols, int first, int width) {
  int left = first - 2, right = first + width + 2;
  int from = MAX(left, 0), to = MIN(right, cols);
  memset(res, row[0], (size_t)(from - left));
  memcpy(res + (from - left), row + from, (size_t)(to - from));
  memset(res + (to - left), row[cols - 1], (size_t)(right - to));
}


WIDE_VECTORS
static void sort_row(uint8_t res[5][STRIP], const uint8_t* piece, int width) {
  for (int x = 0; x < width; x++) {
    uint8_t a = piece[x], b = piece[x + 1], c = piece[x + 2], d = piece[x + 3], e = piece[x + 4];
    SORT5(a, b, c, d, e)
    res[0][x] = a;
    res[1][x] = b;
    res[2][x] = c;
    res[3][x] = d;
    res[4][x] = e;
  }
}


WIDE_VECTORS
static void merge_rows(uint8_t res[10][STRIP], uint8_t a[5][STRIP], uint8_t b[5][STRIP],
                       int width) {
  for (int x = 0; x < width; x++) {
    uint8_t a0 = a[0][x], a1 = a[1][x], a2 = a[2][x], a3 = a[3][x], a4 = a[4][x];
    uint8_t b0 = b[0][x], b1 = b[1][x], b2 = b[2][x], b3 = b[3][x], b4 = b[4][x];
    // those of even index come out as a0 a2 a4 b2 b0 b4, the others as a1 a3 b1 b3
    MERGE3(a0, a2, a4, b0, b2, b4)
    MERGE2(a1, a3, b1, b3)
    ORDER(a1, a2) ORDER(a3, a4) ORDER(b1, b2) ORDER(b3, b0) res[0][x] = a0;
    res[1][x] = a1;
    res[2][x] = a2;
    res[3][x] = a3;
    res[4][x] = a4;
    res[5][x] = b1;
    res[6][x] = b2;
    res[7][x] = b3;
    res[8][x] = b0;
    res[9][x] = b4;
  }
}


// median of six sorted values a0 .. a5 and the sorted row b
#define MEDIAN11(b)                                                            \
  MIN(MIN(MIN(a5, MAX(a4, b[0][x])), MIN(MAX(a3, b[1][x]), MAX(a2, b[2][x]))), \
      MIN(MAX(a1, b[3][x]), MAX(a0, b[4][x])))

// medians of a pixel row and the next: p and q are the four rows that their windows share, `above`
// and `below` what only the first and only the second window has
WIDE_VECTORS
static void medians(uint8_t* restrict first, uint8_t* restrict second, uint8_t p[10][STRIP],
                    uint8_t q[10][STRIP], uint8_t above[5][STRIP], uint8_t below[5][STRIP],
                    int width) {
  for (int x = 0; x < width; x++) {
    // the lower ten of the twenty rise, then fall: the larger of two that are five apart hold
    // their top three
    uint8_t m0 = MAX(MIN(p[0][x], q[9][x]), MIN(p[5][x], q[4][x]));
    uint8_t m1 = MAX(MIN(p[1][x], q[8][x]), MIN(p[6][x], q[3][x]));
    uint8_t a0 = MAX(MIN(p[2][x], q[7][x]), MIN(p[7][x], q[2][x]));
    uint8_t a1 = MAX(MIN(p[3][x], q[6][x]), MIN(p[8][x], q[1][x]));
    uint8_t a2 = MAX(MIN(p[4][x], q[5][x]), MIN(p[9][x], q[0][x]));
    SORT5(m0, m1, a0, a1, a2)
    // and the upper ten the other way round
    uint8_t a3 = MIN(MAX(p[0][x], q[9][x]), MAX(p[5][x], q[4][x]));
    uint8_t a4 = MIN(MAX(p[1][x], q[8][x]), MAX(p[6][x], q[3][x]));
    uint8_t a5 = MIN(MAX(p[2][x], q[7][x]), MAX(p[7][x], q[2][x]));
    uint8_t m6 = MIN(MAX(p[3][x], q[6][x]), MAX(p[8][x], q[1][x]));
    uint8_t m7 = MIN(MAX(p[4][x], q[5][x]), MAX(p[9][x], q[0][x]));
    SORT5(a3, a4, a5, m6, m7)
    first[x] = MEDIAN11(above);
    second[x] = MEDIAN11(below);
  }
}


// sorted rows 2k and 2k + 1, and both merged
static void add_pair(Sorted* sorted, const uint8_t* image, int rows, int cols, ptrdiff_t stride,
                     int first, int width, int k) {
  uint8_t piece[STRIP + 4];
  for (int r = 2 * k; r < 2 * k + 2; r++) {
    int inside = MIN(MAX(r, 0), rows - 1);
    copy_piece(piece, image + inside * stride, cols, first, width);
    sort_row(sorted->row[r & (ROWS - 1)], piece, width);
  }
  merge_rows(sorted->pair[k & (PAIRS - 1)], sorted->row[2 * k & (ROWS - 1)],
             sorted->row[(2 * k + 1) & (ROWS - 1)], width);
}


static void median_strip(uint8_t* res, const uint8_t* image, int rows, int cols, ptrdiff_t stride,
                         int first, int width) {
  Sorted sorted;
  uint8_t line[2][STRIP];
  // over a multiple of the vectors: the rest of the last one is not copied
  int padded = (width + VECTOR - 1) / VECTOR * VECTOR;
  for (int k = -2; k < 1; k++) { add_pair(&sorted, image, rows, cols, stride, first, padded, k); }
  // rows 2k - 1 and 2k share the rows 2k - 2 .. 2k + 1
  for (int k = 0; 2 * k - 1 < rows; k++) {
    add_pair(&sorted, image, rows, cols, stride, first, padded, k + 1);
    medians(line[0], line[1], sorted.pair[(k - 1) & (PAIRS - 1)], sorted.pair[k & (PAIRS - 1)],
            sorted.row[(2 * k - 3) & (ROWS - 1)], sorted.row[(2 * k + 2) & (ROWS - 1)], padded);
    for (int i = 0; i < 2; i++) {
      int y = 2 * k - 1 + i;
      if (y >= 0 && y < rows) { memcpy(res + (ptrdiff_t)y * cols + first, line[i], (size_t)width); }
    }
  }
}


void median5(uint8_t* res, const uint8_t* image, int rows, int cols, ptrdiff_t stride) {
  // strips of even width, so that the last one is not mostly padding
  int strips = (cols + STRIP - 1) / STRIP;
  int width = ((cols + strips - 1) / strips + VECTOR - 1) / VECTOR * VECTOR;
  for (int first = 0; first < cols; first += width) {
    median_strip(res, image, rows, cols, stride, first, MIN(width, cols - first));
  }
}
