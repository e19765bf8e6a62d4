// Takes back what lanes_begin.h defines, and its parameters.
#undef JOIN_
#undef JOIN
#undef NAME
#undef V
#undef M
#undef LANE
#undef NOT
#undef SPLAT
#undef FMA
#undef FNMA
#undef SQRT
#undef MIN
#undef LANES
#undef SUFFIX
