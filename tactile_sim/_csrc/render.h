// Drawing of marker blobs and sensor noise into an 8-bit image.

#ifndef TACTILE_DRIVERS_SIM_RENDER_H_
#define TACTILE_DRIVERS_SIM_RENDER_H_

#include <stdint.h>

// Draw `n` soft discs over a background and quantize with noise.
//   image      height x width, out
//   background height x width, gray levels
//   blobs      n x 4: column, row, radius (pixels), gray level
//   softness   width (pixels) of the discs' edges
//   noise      4096 values that are added at random, from `seed`; none if NULL
//   canvas     height x width: scratch
void render(uint8_t* image, const float* background, int height, int width, const double* blobs,
            int n, double softness, const float* noise, uint64_t seed, float* canvas);

#endif  // TACTILE_DRIVERS_SIM_RENDER_H_
