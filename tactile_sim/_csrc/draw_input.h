// A network's input drawn directly: what crop, median, adaptive threshold, mask and resize would
// make of the image that `render` draws, without that image.

#ifndef TACTILE_DRAW_INPUT_H_
#define TACTILE_DRAW_INPUT_H_

#include <stddef.h>
#include <stdint.h>

// How the input is made of a camera image; lengths in the image's pixels.
typedef struct {
  int size;              // rows and columns of the input
  double left, top;      // of the crop, at the outer edge of its first pixel
  double width, height;  // of one cell: the part of the crop that one pixel is the mean of
  double softness;       // over which a disc's edge fades
  double bend;           // over the radius squared: what the median takes off a disc's radius
  double block;          // side of the threshold's neighborhood
  double level;          // gray levels that a white pixel is above the neighborhood's mean
  double noise;          // of a pixel of the filtered image, gray levels (1 sigma)
} InputView;

// input (size x size) from n discs (column, row, radius, gray) over ground (size x size), each
// cell's gray level, and mask (size x size), the part of each cell that is not masked
//   scratch    draw_input_scratch(view) elements
void draw_input(uint8_t* input, const InputView* view, const double* discs, int n,
                const float* ground, const float* mask, float* scratch);
size_t draw_input_scratch(const InputView* view);

#endif  // TACTILE_DRAW_INPUT_H_
