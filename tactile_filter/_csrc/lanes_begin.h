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


INLINE V NAME(fma)(V a, V b, V c) {
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


// c - a*b
INLINE V NAME(fnma)(V a, V b, V c) {
#if !HAS_FMA
  return c - a*b;
#elif defined(__aarch64__) && LANES > 1 && ELEM_BYTES == 8
  return (V)vfmsq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b);
#elif defined(__aarch64__) && LANES > 1
  return (V)vfmsq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
#elif BYTES == 16 && ELEM_BYTES == 8
  return (V)_mm_fnmadd_pd((__m128d)a, (__m128d)b, (__m128d)c);
#elif BYTES == 16
  return (V)_mm_fnmadd_ps((__m128)a, (__m128)b, (__m128)c);
#elif BYTES == 32 && ELEM_BYTES == 8
  return (V)_mm256_fnmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
#elif BYTES == 32
  return (V)_mm256_fnmadd_ps((__m256)a, (__m256)b, (__m256)c);
#elif BYTES == 64 && ELEM_BYTES == 8
  return (V)_mm512_fnmadd_pd((__m512d)a, (__m512d)b, (__m512d)c);
#elif BYTES == 64
  return (V)_mm512_fnmadd_ps((__m512)a, (__m512)b, (__m512)c);
#else
  return SCALAR_FMA(-a, b, c);
#endif
}


INLINE V NAME(sqrt)(V a) {
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
INLINE V NAME(min)(V a, V b) {
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


INLINE int NAME(any)(M mask) {
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

#if LANES > 1
// elements of 16 bytes, within which elements can change places cheaply
#define BLOCK (16/ELEM_BYTES)


// 16 bytes from each of so many places `step` elements apart that a vector is full
INLINE V NAME(load_blocks)(const ELEM* from, int64_t step) {
#if defined(__x86_64__) && BYTES == 64
  __m512d res = _mm512_castpd128_pd512(_mm_loadu_pd((const double*)from));
  res = _mm512_insertf64x2(res, _mm_loadu_pd((const double*)(from + step)), 1);
  res = _mm512_insertf64x2(res, _mm_loadu_pd((const double*)(from + 2*step)), 2);
  return (V)_mm512_insertf64x2(res, _mm_loadu_pd((const double*)(from + 3*step)), 3);
#elif defined(__x86_64__) && BYTES == 32
  __m256d res = _mm256_castpd128_pd256(_mm_loadu_pd((const double*)from));
  return (V)_mm256_insertf128_pd(res, _mm_loadu_pd((const double*)(from + step)), 1);
#else
  V res;
  (void)step;
  memcpy(&res, from, sizeof(V));
  return res;
#endif
}


// one of them to its place
INLINE void NAME(store_block)(ELEM* to, V v, int which) {
#if defined(__x86_64__) && BYTES == 64
  _mm_storeu_pd((double*)to, which == 0   ? _mm512_castpd512_pd128((__m512d)v)
                             : which == 1 ? _mm512_extractf64x2_pd((__m512d)v, 1)
                             : which == 2 ? _mm512_extractf64x2_pd((__m512d)v, 2)
                                          : _mm512_extractf64x2_pd((__m512d)v, 3));
#elif defined(__x86_64__) && BYTES == 32
  _mm_storeu_pd((double*)to,
                which == 0 ? _mm256_castpd256_pd128((__m256d)v) : _mm256_extractf128_pd((__m256d)v, 1));
#else
  (void)which;
  memcpy(to, &v, sizeof(V));
#endif
}


#if defined(__x86_64__) || defined(__aarch64__)
#if defined(__aarch64__)
#define LOW_(a, b) vzip1q_f64((float64x2_t)(a), (float64x2_t)(b))
#define HIGH_(a, b) vzip2q_f64((float64x2_t)(a), (float64x2_t)(b))
#define LOW_HALF_(a, b) vzip1q_f32((float32x4_t)(a), (float32x4_t)(b))
#define HIGH_HALF_(a, b) vzip2q_f32((float32x4_t)(a), (float32x4_t)(b))
#elif BYTES == 16
#define LOW_(a, b) _mm_unpacklo_pd((__m128d)(a), (__m128d)(b))
#define HIGH_(a, b) _mm_unpackhi_pd((__m128d)(a), (__m128d)(b))
#define LOW_HALF_(a, b) _mm_unpacklo_ps((__m128)(a), (__m128)(b))
#define HIGH_HALF_(a, b) _mm_unpackhi_ps((__m128)(a), (__m128)(b))
#elif BYTES == 32
#define LOW_(a, b) _mm256_unpacklo_pd((__m256d)(a), (__m256d)(b))
#define HIGH_(a, b) _mm256_unpackhi_pd((__m256d)(a), (__m256d)(b))
#define LOW_HALF_(a, b) _mm256_unpacklo_ps((__m256)(a), (__m256)(b))
#define HIGH_HALF_(a, b) _mm256_unpackhi_ps((__m256)(a), (__m256)(b))
#else
#define LOW_(a, b) _mm512_unpacklo_pd((__m512d)(a), (__m512d)(b))
#define HIGH_(a, b) _mm512_unpackhi_pd((__m512d)(a), (__m512d)(b))
#define LOW_HALF_(a, b) _mm512_unpacklo_ps((__m512)(a), (__m512)(b))
#define HIGH_HALF_(a, b) _mm512_unpackhi_ps((__m512)(a), (__m512)(b))
#endif

// rows into columns, within each block
INLINE void NAME(transpose_blocks)(V v[BLOCK]) {
#if ELEM_BYTES == 8
  V low = (V)LOW_(v[0], v[1]), high = (V)HIGH_(v[0], v[1]);
  v[0] = low;
  v[1] = high;
#else
  V a = (V)LOW_HALF_(v[0], v[1]), b = (V)LOW_HALF_(v[2], v[3]);
  V c = (V)HIGH_HALF_(v[0], v[1]), d = (V)HIGH_HALF_(v[2], v[3]);
  v[0] = (V)LOW_(a, b);
  v[1] = (V)HIGH_(a, b);
  v[2] = (V)LOW_(c, d);
  v[3] = (V)HIGH_(c, d);
#endif
}
#undef LOW_
#undef HIGH_
#undef LOW_HALF_
#undef HIGH_HALF_
#else
INLINE void NAME(transpose_blocks)(V v[BLOCK]) {
  for (int i = 0; i < BLOCK; i++) {
    for (int j = 0; j < i; j++) {
      ELEM swap = v[i][j];
      v[i][j] = v[j][i];
      v[j][i] = swap;
    }
  }
}
#endif
#endif

#define FMA NAME(fma)
#define FNMA NAME(fnma)
#define SQRT NAME(sqrt)
#define MIN NAME(min)
