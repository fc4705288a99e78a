/* The code for N states. native/build.py compiles it for each N; with FUSED for processors of the
   kind x86-64 that have AVX2 and FMA. */
#if defined(__SANITIZE_ADDRESS__) && !defined(__clang__)
#pragma GCC optimize("O0") /* vectors with checks take minutes to optimise */
#endif

#include "simulator.h"

#define JOIN(name, n) name##n
#define NAME(name, n) JOIN(name, n)
#ifdef FUSED
const exact_code NAME(exact_fused_, N) = {N, STRIDE, share, prepare, follow, sample};
#else
const exact_code NAME(exact_plain_, N) = {N, STRIDE, share, prepare, follow, sample};
#endif
