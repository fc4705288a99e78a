#if defined(__x86_64__)
#define FUSED
#define N 16
#include "../code.h"
#endif
