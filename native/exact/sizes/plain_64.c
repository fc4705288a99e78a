#define N 64
#include "../code.h"
