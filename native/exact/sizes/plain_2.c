#if !defined(__x86_64__)
#define N 2
#include "../code.h"
#endif
