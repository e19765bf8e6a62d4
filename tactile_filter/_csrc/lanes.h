// Two numbers side by side in the lanes of a 128-bit vector: V the numbers, M a mask for each. What
// is one number stands in both lanes. With HAS_FMA, of the file routines_*.c, a multiply-add is one
// instruction.
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

typedef double V __attribute__((vector_size(16)));
typedef int64_t M __attribute__((vector_size(16)));

#define SPLAT(x) ((V){0} + (double)(x))

// FMA: a*b + c, FNMA: c - a*b
#if defined(__x86_64__) && HAS_FMA
#define FMA(a, b, c) ((V)_mm_fmadd_pd((__m128d)(a), (__m128d)(b), (__m128d)(c)))
#define FNMA(a, b, c) ((V)_mm_fnmadd_pd((__m128d)(a), (__m128d)(b), (__m128d)(c)))
#elif defined(__aarch64__)
#define FMA(a, b, c) ((V)vfmaq_f64((float64x2_t)(c), (float64x2_t)(a), (float64x2_t)(b)))
#define FNMA(a, b, c) ((V)vfmsq_f64((float64x2_t)(c), (float64x2_t)(a), (float64x2_t)(b)))
#else
#define FMA(a, b, c) ((a) * (b) + (c))
#define FNMA(a, b, c) ((c) - (a) * (b))
#endif

#if defined(__x86_64__)
#define SQRT(a) ((V)_mm_sqrt_pd((__m128d)(a)))
#elif defined(__aarch64__)
#define SQRT(a) ((V)vsqrtq_f64((float64x2_t)(a)))
#else
#define SQRT(a) ((V){sqrt((a)[0]), sqrt((a)[1])})
#endif


INLINE int any(M mask) {
  return (mask[0] | mask[1]) != 0;
}


// the sum of both lanes, in both
INLINE V total(V a) {
  return a + (V){a[1], a[0]};
}
