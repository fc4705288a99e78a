#if defined(__x86_64__)
#define FUSED
#define N 2
#include "../code.h"
#endif
