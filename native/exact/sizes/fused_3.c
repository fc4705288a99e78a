#if defined(__x86_64__)
#define FUSED
#define N 3
#include "../code.h"
#endif
