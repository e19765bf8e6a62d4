// Pre-processing of 8-bit images in integers: the same result on every machine.
//
// Images are rows x cols, row-major, `stride` bytes from one row to the next. Beyond its border an
// image goes on with the value at the border, unless said otherwise.

#ifndef TACTILE_IMAGE_H_
#define TACTILE_IMAGE_H_

#include <stddef.h>
#include <stdint.h>

// Loops over bytes gain most from wider vectors: let the loader choose at start-up, where it can.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE_VECTORS __attribute__((target_clones("avx2", "default")))
#else
#define WIDE_VECTORS
#endif

// largest side of the threshold's neighborhood: row sums have 16 bits
enum { THRESHOLD_MAX_BLOCK = 255 };

// largest side of the window of changes: sums in fixed point have 31 bits
enum { CHANGE_MAX_WINDOW = 129 };

// res (rows x cols, contiguous) = median of the 5 x 5 neighborhood
void median5(uint8_t* res, const uint8_t* image, int rows, int cols, ptrdiff_t stride);

// res (rows x cols, contiguous) = mask where a pixel is above the rounded mean of its block x block
// neighborhood less `offset`, else 0
//   mask       rows x cols, contiguous
//   scratch    threshold_scratch(cols, block) elements
void threshold_mean(uint8_t* res, const uint8_t* image, int rows, int cols, ptrdiff_t stride,
                    int block, int offset, const uint8_t* mask, int32_t* scratch);
size_t threshold_scratch(int cols, int block);

// res (size x size, contiguous) = means over equal areas, rounded; size <= rows and cols,
// rows / size < 256, rows * cols < 2^24
//   scratch    shrink_scratch(size, cols) elements
void shrink(uint8_t* res, int size, const uint8_t* image, int rows, int cols, ptrdiff_t stride,
            uint32_t* scratch);
size_t shrink_scratch(int size, int cols);

// largest mean over a window x window patch of max(0, |image - reference| - noise), to 1e-5;
// beyond the border the image goes on mirrored; a pixel's change is at most 1, NaN included
//   image, reference, noise   rows x cols, contiguous, within 0 and 1
//   scratch                   change_scratch(cols, window) elements
double largest_change(const float* image, const float* reference, const float* noise, int rows,
                      int cols, int window, uint32_t* scratch);
size_t change_scratch(int cols, int window);

#endif  // TACTILE_IMAGE_H_
