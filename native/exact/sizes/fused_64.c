#if defined(__x86_64__)
#define FUSED
#define N 64
#include "../code.h"
#endif
