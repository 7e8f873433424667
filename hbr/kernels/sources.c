/* The digest of the sources from which the library was compiled. A library of other sources is not used. */
#include "kernels.h"

EXPORT const char hbr_sources[] = HBR_SOURCES;
