// A kind of vector for the template fusion_lanes.h, from ELEM (double or float), LANES and SUFFIX, and from what the
// file routines_*.c says about the instruction set: HAS_FMA. lanes_end.h takes it all back.
//
// V is a vector of LANES elements, M a mask of the same shape; LANES = 1 is the plain number.

#define JOIN_(name, suffix) name##_##suffix
#define JOIN(name, suffix) JOIN_(name, suffix)
#define NAME(name) JOIN(name, SUFFIX)
#define V NAME(Vec)
#define M NAME(Mask)
#define BYTES (LANES*ELEM_BYTES)

#if ELEM_BYTES == 8
#define ELEM double
#define MASK_ELEM int64_t
#define LARGEST DBL_MAX
#define POOR_PIVOT 1e-7
#define SCALAR_FMA __builtin_fma
#define SCALAR_SQRT __builtin_sqrt
#else
#define ELEM float
#define MASK_ELEM int32_t
#define LARGEST FLT_MAX
#define POOR_PIVOT 1e-4
#define SCALAR_FMA __builtin_fmaf
#define SCALAR_SQRT __builtin_sqrtf
#endif

#if LANES == 1
typedef ELEM V;
typedef int M;
#define LANE(v, lane) (*(&(v) + (lane)))
#define NOT(mask) (!(mask))
#define SPLAT(x) ((ELEM)(x))
#else
typedef ELEM V __attribute__((vector_size(BYTES)));
typedef MASK_ELEM M __attribute__((vector_size(BYTES)));
#define LANE(v, lane) (v)[lane]
#define NOT(mask) (~(mask))
#define SPLAT(x) ((V){0} + (ELEM)(x))
#endif


static inline V NAME(fma)(V a, V b, V c) {
#if !HAS_FMA
  return a*b + c;
#elif LANES == 1
  return SCALAR_FMA(a, b, c);
#elif defined(__aarch64__) && ELEM_BYTES == 8
  return (V)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b);
#elif defined(__aarch64__)
  return (V)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
#elif BYTES == 16 && ELEM_BYTES == 8
  return (V)_mm_fmadd_pd((__m128d)a, (__m128d)b, (__m128d)c);
#elif BYTES == 16
  return (V)_mm_fmadd_ps((__m128)a, (__m128)b, (__m128)c);
#elif BYTES == 32 && ELEM_BYTES == 8
  return (V)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
#elif BYTES == 32
  return (V)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#elif ELEM_BYTES == 8
  return (V)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c);
#else
  return (V)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#endif
}


static inline V NAME(sqrt)(V a) {
#if LANES == 1
  return SCALAR_SQRT(a);
#elif defined(__aarch64__) && ELEM_BYTES == 8
  return (V)vsqrtq_f64((float64x2_t)a);
#elif defined(__aarch64__)
  return (V)vsqrtq_f32((float32x4_t)a);
#elif defined(__x86_64__) && BYTES == 16 && ELEM_BYTES == 8
  return (V)_mm_sqrt_pd((__m128d)a);
#elif defined(__x86_64__) && BYTES == 16
  return (V)_mm_sqrt_ps((__m128)a);
#elif defined(__x86_64__) && BYTES == 32 && ELEM_BYTES == 8
  return (V)_mm256_sqrt_pd((__m256d)a);
#elif defined(__x86_64__) && BYTES == 32
  return (V)_mm256_sqrt_ps((__m256)a);
#elif defined(__x86_64__) && ELEM_BYTES == 8
  return (V)_mm512_sqrt_pd((__m512d)a);
#elif defined(__x86_64__)
  return (V)_mm512_sqrt_ps((__m512)a);
#else
  V res = a;
  for (int lane = 0; lane < LANES; lane++) {
    res[lane] = SCALAR_SQRT(a[lane]);
  }
  return res;
#endif
}


static inline int NAME(any)(M mask) {
#if LANES == 1
  return mask != 0;
#elif defined(__x86_64__) && BYTES == 16
  return _mm_movemask_epi8((__m128i)mask) != 0;
#elif defined(__x86_64__) && BYTES == 32
  return _mm256_movemask_epi8((__m256i)mask) != 0;
#elif defined(__x86_64__) && BYTES == 64
  return _mm512_test_epi64_mask((__m512i)mask, (__m512i)mask) != 0;
#else
  int res = 0;
  for (int lane = 0; lane < LANES; lane++) {
    res |= mask[lane] != 0;
  }
  return res;
#endif
}

#define FMA NAME(fma)
#define SQRT NAME(sqrt)
