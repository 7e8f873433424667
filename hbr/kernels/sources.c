/* Says which sources the library was compiled from: a library that is older than the sources is not used. */
#include "kernels.h"

EXPORT const char hbr_sources[] = HBR_SOURCES;
