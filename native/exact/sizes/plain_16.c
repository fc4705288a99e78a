#if !defined(__x86_64__)
#define N 16
#include "../code.h"
#endif
