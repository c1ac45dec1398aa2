// The beginning of every kernel: extensions, memory layout, thread indices.

#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : enable
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require

// Scalar layout everywhere: a vec3 has twelve bytes on host and device.
layout(scalar) buffer;
layout(scalar) uniform;

// The index of this thread in a one-dimensional dispatch. The host folds more workgroups than a device takes along x
// into rows along y, so the index can exceed the extent: test it before use.
#define THREAD_INDEX \
    ((gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * gl_WorkGroupSize.x + gl_LocalInvocationID.x)
// The index of this workgroup in a one-dimensional dispatch.
#define WORKGROUP_INDEX (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x)
