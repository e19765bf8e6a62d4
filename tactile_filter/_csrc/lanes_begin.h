// A kind of number for the template fusion_lanes.h, from LANES (1: plain doubles, 2: vectors of two), SUFFIX, and from
// what the file routines_*.c says about the instruction set: HAS_FMA. lanes_end.h takes it all back.
//
// V is the number, M a mask of the same shape.

#define JOIN_(name, suffix) name##_##suffix
#define JOIN(name, suffix) JOIN_(name, suffix)
#define NAME(name) JOIN(name, SUFFIX)
#define V NAME(Vec)
#define M NAME(Mask)

#if LANES == 1
typedef double V;
typedef int M;
#define LANE(v, lane) (*(&(v) + (lane)))
#define NOT(mask) (!(mask))
#define SPLAT(x) ((double)(x))
#else
typedef double V __attribute__((vector_size(16)));
typedef int64_t M __attribute__((vector_size(16)));
#define LANE(v, lane) (v)[lane]
#define NOT(mask) (~(mask))
#define SPLAT(x) ((V){0} + (double)(x))
#endif


INLINE V NAME(fma)(V a, V b, V c) {
#if !HAS_FMA
  return a*b + c;
#elif LANES == 1
  return __builtin_fma(a, b, c);
#elif defined(__aarch64__)
  return (V)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b);
#else
  return (V)_mm_fmadd_pd((__m128d)a, (__m128d)b, (__m128d)c);
#endif
}


// c - a*b
INLINE V NAME(fnma)(V a, V b, V c) {
#if !HAS_FMA
  return c - a*b;
#elif LANES == 1
  return __builtin_fma(-a, b, c);
#elif defined(__aarch64__)
  return (V)vfmsq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b);
#else
  return (V)_mm_fnmadd_pd((__m128d)a, (__m128d)b, (__m128d)c);
#endif
}


INLINE V NAME(sqrt)(V a) {
#if LANES == 1
  return __builtin_sqrt(a);
#elif defined(__aarch64__)
  return (V)vsqrtq_f64((float64x2_t)a);
#elif defined(__x86_64__)
  return (V)_mm_sqrt_pd((__m128d)a);
#else
  return (V){__builtin_sqrt(a[0]), __builtin_sqrt(a[1])};
#endif
}


// the smaller one; where one is no number it is b, or no number
INLINE V NAME(min)(V a, V b) {
#if LANES == 1
  return a < b ? a : b;
#elif defined(__aarch64__)
  return (V)vminq_f64((float64x2_t)a, (float64x2_t)b);
#elif defined(__x86_64__)
  return (V)_mm_min_pd((__m128d)a, (__m128d)b);
#else
  return (V){a[0] < b[0] ? a[0] : b[0], a[1] < b[1] ? a[1] : b[1]};
#endif
}


INLINE int NAME(any)(M mask) {
#if LANES == 1
  return mask != 0;
#elif defined(__x86_64__)
  return _mm_movemask_epi8((__m128i)mask) != 0;
#else
  return (mask[0] | mask[1]) != 0;
#endif
}

#define FMA NAME(fma)
#define FNMA NAME(fnma)
#define SQRT NAME(sqrt)
#define MIN NAME(min)
