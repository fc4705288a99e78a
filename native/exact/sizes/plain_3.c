#define N 3
#include "../code.h"
