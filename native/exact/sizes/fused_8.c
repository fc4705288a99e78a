#if defined(__x86_64__)
#define FUSED
#define N 8
#include "../code.h"
#endif
