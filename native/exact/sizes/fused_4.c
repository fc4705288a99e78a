#if defined(__x86_64__)
#define FUSED
#define N 4
#include "../code.h"
#endif
