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
#define ASYMMETRY SYMMETRY_TOLERANCE
#define SKEWNESS ROTATION_TOLERANCE
#define SCALAR_FMA __builtin_fma
#define SCALAR_SQRT __builtin_sqrt
#else
#define ELEM float
#define MASK_ELEM int32_t
#define LARGEST FLT_MAX
#define POOR_PIVOT 1e-4
#define ASYMMETRY 1e-5
#define SKEWNESS 1e-5
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


// the smaller one; where one is no number it is b, or no number
static inline V NAME(min)(V a, V b) {
#if LANES == 1
  return a < b ? a : b;
#elif defined(__aarch64__) && ELEM_BYTES == 8
  return (V)vminq_f64((float64x2_t)a, (float64x2_t)b);
#elif defined(__aarch64__)
  return (V)vminq_f32((float32x4_t)a, (float32x4_t)b);
#elif defined(__x86_64__) && BYTES == 16 && ELEM_BYTES == 8
  return (V)_mm_min_pd((__m128d)a, (__m128d)b);
#elif defined(__x86_64__) && BYTES == 16
  return (V)_mm_min_ps((__m128)a, (__m128)b);
#elif defined(__x86_64__) && BYTES == 32 && ELEM_BYTES == 8
  return (V)_mm256_min_pd((__m256d)a, (__m256d)b);
#elif defined(__x86_64__) && BYTES == 32
  return (V)_mm256_min_ps((__m256)a, (__m256)b);
#elif defined(__x86_64__) && ELEM_BYTES == 8
  return (V)_mm512_min_pd((__m512d)a, (__m512d)b);
#elif defined(__x86_64__)
  return (V)_mm512_min_ps((__m512)a, (__m512)b);
#else
  V res = b;
  for (int lane = 0; lane < LANES; lane++) {
    res[lane] = a[lane] < b[lane] ? a[lane] : b[lane];
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

// whether there is a transpose for this vector
#if defined(__x86_64__) && ELEM_BYTES == 8 && (LANES == 8 || LANES == 4)
#define HAS_TRANSPOSE 1
#else
#define HAS_TRANSPOSE 0
#endif

#if HAS_TRANSPOSE && LANES == 8
#define LOW(a, b) (V)_mm512_unpacklo_pd((__m512d)(a), (__m512d)(b))
#define HIGH(a, b) (V)_mm512_unpackhi_pd((__m512d)(a), (__m512d)(b))
#define EVEN(a, b) (V)_mm512_shuffle_f64x2((__m512d)(a), (__m512d)(b), 0x88)
#define ODD(a, b) (V)_mm512_shuffle_f64x2((__m512d)(a), (__m512d)(b), 0xdd)

// the matrix of eight vectors transposed
static inline void NAME(transpose)(V r[8]) {
  V low[4], high[4], quad[8];
  UNROLL
  for (int i = 0; i < 4; i++) {
    low[i] = LOW(r[2*i], r[2*i+1]);
    high[i] = HIGH(r[2*i], r[2*i+1]);
  }
  UNROLL
  for (int i = 0; i < 2; i++) {
    quad[i] = EVEN(low[2*i], low[2*i+1]);
    quad[2+i] = EVEN(high[2*i], high[2*i+1]);
    quad[4+i] = ODD(low[2*i], low[2*i+1]);
    quad[6+i] = ODD(high[2*i], high[2*i+1]);
  }
  UNROLL
  for (int i = 0; i < 4; i++) {
    r[i] = EVEN(quad[2*i], quad[2*i+1]);
    r[4+i] = ODD(quad[2*i], quad[2*i+1]);
  }
}
#undef LOW
#undef HIGH
#undef EVEN
#undef ODD
#elif HAS_TRANSPOSE
// the matrix of four vectors transposed
static inline void NAME(transpose)(V r[4]) {
  __m256d a = _mm256_unpacklo_pd((__m256d)r[0], (__m256d)r[1]);
  __m256d b = _mm256_unpackhi_pd((__m256d)r[0], (__m256d)r[1]);
  __m256d c = _mm256_unpacklo_pd((__m256d)r[2], (__m256d)r[3]);
  __m256d d = _mm256_unpackhi_pd((__m256d)r[2], (__m256d)r[3]);
  r[0] = (V)_mm256_permute2f128_pd(a, c, 0x20);
  r[1] = (V)_mm256_permute2f128_pd(b, d, 0x20);
  r[2] = (V)_mm256_permute2f128_pd(a, c, 0x31);
  r[3] = (V)_mm256_permute2f128_pd(b, d, 0x31);
}
#endif

#define FMA NAME(fma)
#define SQRT NAME(sqrt)
#define MIN NAME(min)
