// Drawing of marker blobs and sensor noise into an 8-bit image.

#include "render.h"

#include <math.h>
#include <string.h>


static int clamp(double value, int low, int high) {
  return value < low ? low : value > high ? high : (int)value;
}


// one disc whose edge falls smoothly over `softness` pixels
static void draw_disc(float* canvas, int height, int width, const double blob[4], double softness) {
  double reach = blob[2] + softness / 2;
  if (!(reach > 0) || !isfinite(blob[0]) || !isfinite(blob[1])) { return; }
  int left = clamp(ceil(blob[0] - reach), 0, width),
      right = clamp(floor(blob[0] + reach) + 1, 0, width);
  int top = clamp(ceil(blob[1] - reach), 0, height),
      bottom = clamp(floor(blob[1] + reach) + 1, 0, height);
  float inner = (float)fmax(blob[2] - softness / 2, 0), span = (float)reach - inner;
  for (int row = top; row < bottom; row++) {
    float dy = (float)(row - blob[1]);
    float* line = canvas + (size_t)row * width;
    for (int column = left; column < right; column++) {
      float dx = (float)(column - blob[0]), distance = sqrtf(dx * dx + dy * dy);
      float t = ((float)reach - distance) / span;
      t = t < 0 ? 0 : t > 1 ? 1 : t;
      line[column] += ((float)blob[3] - line[column]) * t * t * (3 - 2 * t);
    }
  }
}


// splitmix64: one add and three mixes a draw, any seed is good
static uint64_t next_random(uint64_t* state) {
  uint64_t z = (*state += 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return z ^ (z >> 31);
}


static void add_noise(float* canvas, int count, const float* noise, uint64_t seed) {
  int k = 0;
  for (; k + 4 <= count; k += 4) {
    uint64_t bits = next_random(&seed);
    for (int j = 0; j < 4; j++) { canvas[k + j] += noise[(bits >> (16 * j)) & 4095]; }
  }
  for (; k < count; k++) { canvas[k] += noise[next_random(&seed) & 4095]; }
}


void render(uint8_t* image, const float* background, int height, int width, const double* blobs,
            int n, double softness, const float* noise, uint64_t seed, float* canvas) {
  int count = height * width;
  memcpy(canvas, background, count * sizeof(float));
  for (int i = 0; i < n; i++) { draw_disc(canvas, height, width, blobs + 4 * i, softness); }
  if (noise) { add_noise(canvas, count, noise, seed); }
  for (int k = 0; k < count; k++) {
    float value = canvas[k] + 0.5f;
    value = value > 0 ? value : 0;  // NaN is black, too
    image[k] = (uint8_t)(value > 255 ? 255 : value);
  }
}
