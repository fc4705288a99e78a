/* The code for N states. native/build.py compiles it for each N; with FUSED for processors of the
   kind x86-64 that have AVX2 and FMA; with WIDE for those that have AVX-512's 32 registers, too. */
#if defined(__SANITIZE_ADDRESS__) && !defined(__clang__)
#pragma GCC optimize("O0") /* vectors with checks take minutes to optimise */
#endif

#include "simulator.h"

#define JOIN(name, n) name##n
#define NAME(name, n) JOIN(name, n)
#if defined(WIDE)
const exact_code NAME(exact_wide_, N) = {N, STRIDE, share, prepare, follow, sample};
#elif defined(FUSED)
const exact_code NAME(exact_fused_, N) = {N, STRIDE, share, prepare, follow, sample};
#else
const exact_code NAME(exact_plain_, N) = {N, STRIDE, share, prepare, follow, sample};
#endif
