/* gsfixer_traj.h - cameras and camera paths: pure functions on caller memory
   SPDX-License-Identifier: MIT
*/
#ifndef GSF_TRAJ_INCLUDED
#define GSF_TRAJ_INCLUDED

#include "gsfixer.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef __cplusplus
}
#endif

#endif // GSF_TRAJ_INCLUDED

// ================================================================================
// The API ends here. What follows is the implementation.
// ================================================================================

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_TRAJ_IMPLEMENTATION)
#define GSFIXER_TRAJ_IMPLEMENTATION
#endif
#if defined(GSFIXER_TRAJ_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_TRAJ_IMPLEMENTED
#define GSF_TRAJ_IMPLEMENTED

#include "gsfixer.h" // again: its internals, if all was included before without an implementation macro

GSF__BEGIN_IMPLEMENTATION

GSF__END_IMPLEMENTATION

#endif // GSF_TRAJ_IMPLEMENTED
#endif // GSFIXER_TRAJ_IMPLEMENTATION
