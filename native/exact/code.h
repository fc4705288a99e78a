/* The code for N states. With FUSED it is for processors of the kind x86-64 that have AVX2 and FMA.
 */
#if defined(__SANITIZE_ADDRESS__) && !defined(__clang__)
#pragma GCC optimize("O0") /* vectors with checks take minutes to optimise */
#endif
#ifdef FUSED
#ifdef __clang__
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC target("avx2,fma")
#endif
#endif

#include "simulator.h"

#define JOIN(name, n) name##n
#define NAME(name, n) JOIN(name, n)
#ifdef FUSED
const exact_code NAME(exact_fused_, N) = {N, STRIDE, share, prepare, follow, sample};
#else
const exact_code NAME(exact_plain_, N) = {N, STRIDE, share, prepare, follow, sample};
#endif

#if defined(FUSED) && defined(__clang__)
#pragma clang attribute pop
#endif
