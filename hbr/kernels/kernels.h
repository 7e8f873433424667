/* Shared by the kernels. They call no library, so that one binary runs on every Linux of its architecture. */
#ifndef HBR_KERNELS_H
#define HBR_KERNELS_H

#include <features.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

/* A function for every x86-64 processor, and again for those with AVX2; the loader chooses. On aarch64 the vector
   instructions are always there. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define FOR_EVERY_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "avx2", "default")))
#else
#define FOR_EVERY_PROCESSOR
#endif

/* A part of such a function: without this, the compiler calls one version of it from all of them. */
#define PART static inline __attribute__((always_inline))

#endif
