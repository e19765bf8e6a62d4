// The routines for the instruction set that every machine of this kind has.
#include "se3_routines.h"

#define ROUTINES se3_routines_base
#define ROUTINES_NAME "base"
#include "se3_routines_table.h"
