/* Gaussian splatting on the host's VkDevice. C99 and C++11. Written by cbindgen from src/capi: edit that.

   Every pointer is read during the call alone. An NspDevice may be used from any thread; a model, a renderer or a
   trainer from one at a time. Nothing is global but nsp_set_log. Structs that begin with struct_size are set to zero
   and to their size first; their members are only appended. docs/embedding.md is the contract. */

#ifndef NIGHTSPLAT_H
#define NIGHTSPLAT_H

#include <stddef.h>
#include <stdint.h>
#include <vulkan/vulkan_core.h>

// The version of this header, as `VK_MAKE_API_VERSION(0, major, minor, patch)`.
#define NSP_HEADER_VERSION (1 << 12)

// The library submits nothing: uploads are part of the next recording, and training is refused.
#define NSP_DEVICE_RECORD_ONLY 1

// The queue is internally synchronized (`VK_KHR_internally_synchronized_queues`): no lock is taken.
#define NSP_DEVICE_QUEUE_SYNCHRONIZED 2

// `VK_EXT_debug_utils` is enabled on the instance: objects are named, and passes are labelled.
#define NSP_DEVICE_NAMES_OBJECTS 4

// The lens is a fisheye (Kannala and Brandt); otherwise the camera is a pinhole.
#define NSP_CAMERA_FISHEYE 1

// The camera is orthographic.
#define NSP_CAMERA_ORTHOGRAPHIC 2

// The instance is not drawn.
#define NSP_INSTANCE_HIDDEN 1

// Splats whose centres are outside of `clip_min` to `clip_max` are not drawn.
#define NSP_INSTANCE_CLIP 2

// Blends over the contents of `color` instead of replacing them.
#define NSP_RENDER_OVER 1

// Writes display-referred values, as they were trained, to a float `color` image; otherwise linear light.
#define NSP_RENDER_DISPLAY_FLOAT 2

// `scene_depth`, and `depth_out` in D32, are reversed: 1 at the near plane, 0 at the far plane.
#define NSP_DEPTH_REVERSED 4

// `scene_depth` is linear view-space depth in world units.
#define NSP_DEPTH_LINEAR 8

// `depth_out` is the expected depth, the mean of the splats' depths by their blending weights; otherwise the median
// depth, at which the transmittance falls below 1/2.
#define NSP_DEPTH_EXPECTED 16

// Renders the colours of the dark photographs, by inverting the tone law that the model states: linear light in a
// linear image, encoded values otherwise. `background` is not changed.
#define NSP_RENDER_PHOTOGRAPH 32

// `pick` is a pixel of the first camera, of which `nsp_renderer_picked` tells what is there.
#define NSP_RENDER_PICK 64

// All cameras have one sort, by the depth along the mean of their axes: pinholes or orthographic, which look at most
// 30 degrees beside it. Where their axes are parallel, the pictures are the same; else splats that intersect may
// change their order.
#define NSP_RENDER_ONE_SORT 128

// A device. Any thread may use it.
typedef struct NspDevice NspDevice;

// A model on a device. Use it from one thread at a time.
typedef struct NspModel NspModel;

// A renderer: compiled kernels, and memory that grows with the views. Use it from one thread at a time.
typedef struct NspRenderer NspRenderer;

// A training run. Use it from one thread at a time. Experimental: what begins with `nsp_trainer` may change.
typedef struct NspTrainer NspTrainer;

// Follows trainers and stops them, from any thread. Experimental.
typedef struct NspWatch NspWatch;

// 0 or more: success. Otherwise an error, whose message `nsp_last_error` returns.
typedef int32_t NspResult;

// The structs that `nsp_require_features` chains where the host has none. They stay where they are until the device is
// created.
typedef struct NspFeatureStructs {
    // `sizeof(NspFeatureStructs)`.
    size_t struct_size;
    // Chained by the library, as all below.
    VkPhysicalDeviceTimelineSemaphoreFeatures timeline_semaphore;
    // Chained by the library.
    VkPhysicalDeviceScalarBlockLayoutFeatures scalar_block_layout;
    // Chained by the library.
    VkPhysicalDeviceSynchronization2Features synchronization2;
    // Chained by the library.
    VkPhysicalDeviceSubgroupSizeControlFeatures subgroup_size_control;
} NspFeatureStructs;

// A range of device memory that the host allocated.
typedef struct NspMemory {
    // The memory object.
    VkDeviceMemory memory;
    // Bytes from the start of the memory object; a multiple of the required alignment.
    VkDeviceSize offset;
    // The mapped address of the first byte if host-visible memory is required; ignored otherwise.
    void *mapped;
    // For the host's use.
    void *cookie;
} NspMemory;

// The host's allocator of device memory. It may be called from any thread, and must not throw.
typedef struct NspMemoryFunctions {
    // `sizeof(NspMemoryFunctions)`.
    size_t struct_size;
    // Writes to `out` memory that has all `required` properties and, if there is such memory, all `preferred` ones.
    VkResult (*allocate)(void *user,
                         const VkMemoryRequirements *requirements,
                         VkMemoryPropertyFlags required,
                         VkMemoryPropertyFlags preferred,
                         const char *name,
                         struct NspMemory *out);
    // Frees memory of `allocate`.
    void (*free)(void *user, const struct NspMemory *memory);
    // Passed to both functions.
    void *user;
} NspMemoryFunctions;

// A device that the host lends. It outlives everything that is made with it.
typedef struct NspHostDevice {
    // `sizeof(NspHostDevice)`.
    size_t struct_size;
    // The function of the host's Vulkan loader.
    PFN_vkGetInstanceProcAddr get_instance_proc_addr;
    // An instance of Vulkan 1.1 or later. Below 1.3, the device has `VK_KHR_synchronization2` and
    // `VK_EXT_subgroup_size_control`; at 1.1, also `VK_KHR_timeline_semaphore`, `VK_EXT_scalar_block_layout` and
    // `VK_KHR_spirv_1_4`.
    VkInstance instance;
    // A physical device of the instance.
    VkPhysicalDevice physical_device;
    // A device that was created with the features of `nsp_require_features`.
    VkDevice device;
    // A queue of the family below; NULL with `NSP_DEVICE_RECORD_ONLY`.
    VkQueue queue;
    // The index of a queue family with compute.
    uint32_t queue_family;
    // `NSP_DEVICE_*`.
    uint32_t flags;
    // The names of the enabled device extensions; others are not used.
    const char *const *extensions;
    // The number of extensions.
    uint32_t extension_count;
    // The enabled features, with what is chained to it; NULL: those of `nsp_require_features`.
    const VkPhysicalDeviceFeatures2 *features;
    // Locks the queue around each `vkQueueSubmit2`; set both functions, or none.
    void (*lock_queue)(void *user, VkQueue queue);
    // Unlocks the queue.
    void (*unlock_queue)(void *user, VkQueue queue);
    // Passed to both functions.
    void *user;
    // The host's pipeline cache; `VK_NULL_HANDLE`: one of the library's, which is not saved.
    VkPipelineCache pipeline_cache;
    // Allocates host memory for the objects that the library creates; NULL: the driver's. It outlives the device.
    const VkAllocationCallbacks *host_memory;
    // Allocates device memory; NULL: the library allocates blocks of 8 to 256 MiB.
    const struct NspMemoryFunctions *device_memory;
    // A timeline semaphore that reaches the number of each frame; `VK_NULL_HANDLE`: the host calls `nsp_frames_done`.
    VkSemaphore frames;
} NspHostDevice;

// A camera, in axes x right, y down, z forward.
typedef struct NspCamera {
    // `sizeof(NspCamera)`; in an array, the distance between elements.
    size_t struct_size;
    // Width in pixels.
    uint32_t width;
    // Height in pixels.
    uint32_t height;
    // Focal lengths along x and y in pixels; with `NSP_CAMERA_ORTHOGRAPHIC` pixels per world unit.
    double focal[2];
    // The principal point in pixels, from the top left corner of the image.
    double principal_point[2];
    // The rigid transform from world to view space, three rows of four.
    double view_from_world[12];
    // `NSP_CAMERA_*`.
    uint32_t flags;
    // Unused.
    uint32_t reserved;
    // With `NSP_CAMERA_FISHEYE`: k1 to k4 of its model, as in `OpenCV`.
    double distortion[4];
} NspCamera;

// The properties of a model.
typedef struct NspModelInfo {
    // `sizeof(NspModelInfo)`.
    size_t struct_size;
    // The number of Gaussians.
    uint32_t count;
    // The SH degree, 0 to 3.
    uint32_t sh_degree;
    // The near plane of the training, in world units.
    float near_plane;
    // The largest alpha of a splat on a pixel.
    float max_alpha;
    // 1 if colours are the raw SH sum, without the usual offset of 0.5.
    uint32_t raw_colors;
    // The brightness of the model's colours relative to the photographs, in stops of linear light: with
    // `NSP_RENDER_PHOTOGRAPH` and an exposure of 2^`law_stops`, renders are as bright as the model. NaN: the model
    // states no tone law.
    float law_stops;
    // The position of the model's origin in the world.
    double origin[3];
} NspModelInfo;

// The outcome of the newest frame that is done.
typedef struct NspStatus {
    // `sizeof(NspStatus)`.
    size_t struct_size;
    // The number of the frame; 0: none is done yet.
    uint64_t frame;
    // Intersections of splats and tiles, in the view that has the most.
    uint32_t intersections;
    // The intersections that memory and budget allowed.
    uint32_t capacity;
    // The intersections that were left out, the farthest.
    uint32_t left_out;
    // The splats of the fullest tile if the device cannot process that many, and the tile is not drawn; else 0.
    uint32_t splats_per_tile;
    // Bytes of device memory in use by all objects of the device.
    uint64_t device_bytes;
} NspStatus;

// What the newest pick that is done found.
typedef struct NspPick {
    // `sizeof(NspPick)`.
    size_t struct_size;
    // The number of its frame; 0: none is done yet.
    uint64_t frame;
    // 1: a splat blocks half of the light, with those before it; 0: none does, and the rest is 0.
    uint32_t is_hit;
    // The index in `NspRender::instances`; 0 where a model is drawn.
    uint32_t instance;
    // The index of the splat's Gaussian in its model.
    uint32_t gaussian;
    // Its depth in the view, world units.
    float depth;
} NspPick;

// The state of an image before or after a recording.
typedef struct NspImageState {
    // The image layout.
    VkImageLayout layout;
    // The queue family that owns the image; read if `is_owned`.
    uint32_t family;
    // The pipeline stages in which the host uses the image.
    VkPipelineStageFlags2 stages;
    // The host's accesses in these stages.
    VkAccessFlags2 access;
    // 1: `family` owns the image, and if it is not the lent family, the library's half of the ownership transfer is
    // recorded; 0: ownership is not transferred.
    uint32_t is_owned;
    // Unused.
    uint32_t reserved;
} NspImageState;

// An array layer of an image: mip level 0, single-sampled. Its usage includes `TRANSFER_DST` if it is written, and
// `TRANSFER_SRC` if it is read.
typedef struct NspImage {
    // `sizeof(NspImage)`.
    size_t struct_size;
    // The image.
    VkImage image;
    // Its format.
    VkFormat format;
    // Width and height in pixels, at least those of the cameras.
    VkExtent2D extent;
    // The array layer of the first camera.
    uint32_t layer;
    // The number of array layers; 0 stands for 1.
    uint32_t layers;
    // The state in which the host leaves the image.
    struct NspImageState before;
    // The state after the render.
    struct NspImageState after;
} NspImage;

// A model in a render of several. One model can have many instances; it is uploaded once. Experimental.
typedef struct NspInstance {
    // `sizeof(NspInstance)`; in an array, the distance between elements.
    size_t struct_size;
    // The model; NULL with a trainer.
    const struct NspModel *model;
    // A trainer whose Gaussians are drawn as they are, without a copy: the recording is submitted before the next call
    // of `nsp_trainer_advance`, to the same queue. NULL: a model.
    const struct NspTrainer *trainer;
    // The rigid transform from the model's world to that of the cameras, three rows of four; all zeros: none.
    double pose[12];
    // The factor on lengths of the model, before the pose; 0 stands for 1.
    double scale;
    // Factors of display-referred red, green and blue, 0 or more, and of the opacity, 0 to 1; all zeros stand for
    // ones.
    float tint[4];
    // The least corner of the clip box, in the model's world.
    double clip_min[3];
    // The greatest corner of the clip box.
    double clip_max[3];
    // `NSP_INSTANCE_*`.
    uint32_t flags;
    // Unused.
    uint32_t reserved;
    // `pose` in the frame before, for motion vectors; all zeros: as in this frame, and `scale` too.
    double pose_before[12];
    // `scale` in the frame before; 0 stands for 1.
    double scale_before;
} NspInstance;

// The parameters of a render.
typedef struct NspRender {
    // `sizeof(NspRender)`.
    size_t struct_size;
    // A primary command buffer of the lent queue family, in the recording state, outside a render pass. The host
    // submits it once, in the order of recording.
    VkCommandBuffer commands;
    // The value that the host's timeline semaphore reaches when the command buffer is done; it never decreases.
    uint64_t frame;
    // Camera i is drawn into layer `layer + i` of each image.
    const struct NspCamera *cameras;
    // The number of cameras.
    uint32_t camera_count;
    // `NSP_RENDER_*` and `NSP_DEPTH_*`.
    uint32_t flags;
    // Colour with premultiplied alpha: RGBA16F, RGBA32F or B10G11R11 (linear), RGBA8 or BGRA8 as UNORM or SRGB,
    // A2B10G10R10 or A2R10G10B10 (UNORM); NULL: none.
    const struct NspImage *color;
    // Depth; NULL: none. As R32F: in the view, infinite where there is no splat. As D32, with or without stencil: by
    // the projection of `scene_near`, `scene_far` and `NSP_DEPTH_REVERSED`, and at the far plane where there is no
    // splat; it may be the image of `scene_depth`, which keeps its depth there.
    const struct NspImage *depth_out;
    // The host's depth buffer, which occludes splats: D32, D24 or D16 with or without stencil, or R32F; NULL: none.
    const struct NspImage *scene_depth;
    // The near plane of the host's depth in world units.
    float scene_near;
    // The far plane of the host's depth in world units; 0: at infinity.
    float scene_far;
    // The factor on linear light; 0 stands for 1.
    float exposure;
    // The background colour, display-referred; not used with `NSP_RENDER_OVER`.
    float background[3];
    // The most intersections of splats and tiles in a view, of which the farthest are left out first; 0: as memory
    // allows.
    uint32_t budget;
    // The number of instances.
    uint32_t instance_count;
    // The models that are drawn, sorted together; NULL: the model that is passed.
    const struct NspInstance *instances;
    // `color` of ten bits is HDR10 (BT.2020, ST 2084), and linear light 1 is this many nits; 0: display-referred.
    float hdr10_nits;
    // With `NSP_RENDER_PICK`: column and row.
    uint32_t pick[2];
    // Unused.
    uint32_t reserved;
    // Motion vectors as RG16F or RG32F: from each pixel to where its point was in the frame before, in pixels; NULL:
    // none. The point is at the depth in the view, infinitely far where there is no splat, and moves with the camera
    // and with the instance (`NspInstance::pose_before`) of the splat at which half of the light is blocked.
    const struct NspImage *motion_out;
    // The cameras of the frame before, as many as `cameras`, of the same sizes and models; read with `motion_out`.
    // With the principal point of this frame's, a jitter is left out.
    const struct NspCamera *cameras_before;
} NspRender;

// A training step. Experimental.
typedef struct NspStep {
    // `sizeof(NspStep)`; of the first of an array, the distance between its elements.
    size_t struct_size;
    // Counted from 1.
    uint64_t step;
    // The weighted sum of its loss terms.
    double loss;
    // The number of Gaussians.
    uint32_t gaussians;
    // Unused.
    uint32_t reserved;
} NspStep;

// The mean score of the held-out views after a step. Experimental.
typedef struct NspScore {
    // `sizeof(NspScore)`; of the first of an array, the distance between its elements.
    size_t struct_size;
    // Counted from 1.
    uint64_t step;
    // dB, against the targets of the views.
    double psnr;
} NspScore;

// Success.
#define NSP_OK 0

// An argument is invalid; nothing was recorded.
#define NSP_ERROR_USAGE -2

// A file is missing or invalid.
#define NSP_ERROR_INPUT -3

// The device lacks a feature, or one of its limits is too low.
#define NSP_ERROR_DEVICE -4

// Out of device or host memory; the object is unchanged.
#define NSP_ERROR_MEMORY -5

// The device was lost; destroy everything.
#define NSP_ERROR_LOST -6

// A file cannot be written.
#define NSP_ERROR_OUTPUT -7

// A `struct_size` is below that of version 0.1, or members that this library does not know are not zero.
#define NSP_ERROR_VERSION -8

// This build cannot train, or does not read the file format.
#define NSP_ERROR_UNSUPPORTED -9

// A number is NaN or infinite.
#define NSP_ERROR_NOT_FINITE -10

// The work was stopped on request.
#define NSP_ERROR_STOPPED -11

// A bug in the library was caught; the object can only be destroyed.
#define NSP_ERROR_INTERNAL -127

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// The message of this thread's last error: one line, never NULL, valid until the thread's next error.
const char *nsp_last_error(void);

// The library's version, as `VK_MAKE_API_VERSION(0, major, minor, patch)`.
uint32_t nsp_version(void);

// Sets the function that receives the lines of the log, from any thread; NULL: none. `level` is 1 for errors, 2 for
// warnings, 3 for information. This is the only global state.
void nsp_set_log(void (*log)(void *user, int32_t level, const char *line), void *user);

// Enables the features that the library needs in the chain with which the host creates its device. `chain` is the
// host's `VkDeviceCreateInfo` or `VkPhysicalDeviceFeatures2`. Each feature is enabled in the struct of the chain that
// has it, of a Vulkan version or of an extension; for the others, structs of `structs` are appended.
NspResult nsp_require_features(void *chain, struct NspFeatureStructs *structs);

// The optional device extensions with which recording is faster, and their number.
const char *const *nsp_device_extensions(uint32_t *count);

// Whether the library can use a physical device; the error names what is missing.
NspResult nsp_check_device(PFN_vkGetInstanceProcAddr get_instance_proc_addr,
                           VkInstance instance,
                           VkPhysicalDevice physical_device);

// Creates a device from one that the host lends. Nothing is submitted.
NspResult nsp_device_from_host(const struct NspHostDevice *host, struct NspDevice **device);

// Opens a device of the library's own, for training without a host's. `choice` is a value of `nightsplat --device`;
// NULL or empty: the best device.
NspResult nsp_device_open(const char *choice, struct NspDevice **device);

// Records the uploads that wait, and nothing else, so that a loading screen or a transfer needs no picture. `commands`
// and `frame` are as in `NspRender`.
NspResult nsp_record_uploads(struct NspDevice *device, VkCommandBuffer commands, uint64_t frame);

// Reports that all frames up to `frame` are done or were never submitted, and frees what they used. Uploads of a
// recording that was never submitted are part of the next one. `UINT64_MAX`
// stands for all frames, also after the device was lost.
NspResult nsp_frames_done(struct NspDevice *device, uint64_t frame);

// Destroys a device. All frames must be done; nothing is waited for.
void nsp_device_destroy(struct NspDevice *device);

// The camera of an engine's column-major view and projection matrices, for Vulkan's clip space (x right, y down,
// depth 0 to 1, or reversed). The camera may look along z or -z, with y up or down. `width` and `height` are those of
// the viewport in pixels. An orthographic projection gives an orthographic camera, which looks along the axis that
// makes its image no mirror of the world.
//
// Errors: `NSP_ERROR_USAGE` if the projection is sheared, or if the matrices scale or mirror the world.
NspResult nsp_camera_from_matrices(const float *view,
                                   const float *projection,
                                   uint32_t width,
                                   uint32_t height,
                                   struct NspCamera *camera);

// Loads a model: PLY, SPZ, SOG, or a run directory. The upload is part of the next recording. Gaussians that are not
// finite are left out, which a warning of the log counts.
NspResult nsp_model_load(struct NspDevice *device, const char *path, struct NspModel **model);

// Creates a model from arrays: means (count, 3); rotations (count, 4) as w, x, y, z; natural logarithms of scales
// (count, 3); opacities before the sigmoid (count); SH of degree 0 (count, 3); SH above it (count,
// (degree + 1)^2 - 1, 3), NULL for degree 0.
NspResult nsp_model_create(struct NspDevice *device,
                           uint32_t count,
                           uint32_t sh_degree,
                           const float *const *planes,
                           struct NspModel **model);

// Joins models into one, each moved by a rigid transform (three rows of four), so that all splats are sorted
// together. The near plane is that of the first model. All have the same kind of colours and the same alpha limit.
NspResult nsp_model_join(struct NspDevice *device,
                         const struct NspModel *const *models,
                         const double (*poses)[12],
                         uint32_t count,
                         struct NspModel **model);

// The number of Gaussians; 0 for NULL.
uint32_t nsp_model_count(const struct NspModel *model);

// Writes the properties of a model to `info`.
NspResult nsp_model_info(const struct NspModel *model, struct NspModelInfo *info);

// Destroys a model; frames that show it may be in flight.
void nsp_model_destroy(struct NspModel *model);

// Creates a renderer for models with the SH degree, near plane, colours and tone law of `model`.
NspResult nsp_renderer_create(struct NspDevice *device, const struct NspModel *model, struct NspRenderer **renderer);

// Allocates memory for views of this size and for this many intersections, ahead of the first recording.
NspResult nsp_renderer_reserve(struct NspRenderer *renderer, uint32_t width, uint32_t height, uint32_t intersections);

// Writes the outcome of the newest frame that is done to `status`. It never waits.
NspResult nsp_renderer_status(const struct NspRenderer *renderer, struct NspStatus *status);

// Writes what the newest pick that is done found to `pick`. It never waits.
NspResult nsp_renderer_picked(const struct NspRenderer *renderer, struct NspPick *pick);

// Destroys a renderer; frames that use it may be in flight.
void nsp_renderer_destroy(struct NspRenderer *renderer);

// Records the render of a model, or of `NspRender::instances` if `model` is NULL. Nothing is submitted, and nothing is
// waited for. If the view needs more memory than there is, the nearest splats are drawn, and a later call allocates
// more.
//
// It binds compute pipelines, descriptor set 0 and push constants, and restores none of them.
NspResult nsp_record_render(struct NspRenderer *renderer, const struct NspModel *model, const struct NspRender *render);

// Creates a watch. `progress` is called with a stage, such as "decoding photographs" or "training", how much of it is
// done, and all of it: from any thread, by one at a time. It may call `nsp_watch_stop`, and nothing else of the
// library. NULL: progress is not told.
NspResult nsp_watch_create(void (*progress)(void *user, const char *stage, uint64_t done, uint64_t all),
                           void *user,
                           struct NspWatch **watch);

// Stops the call of a trainer that is running with the watch, or the next: it returns `NSP_ERROR_STOPPED`, after a
// call that reports the steps done so far where there are any. The trainer can go on afterwards. May be called from
// any thread.
NspResult nsp_watch_stop(const struct NspWatch *watch);

// Destroys a watch; trainers go on without it.
void nsp_watch_destroy(struct NspWatch *watch);

// Creates a trainer for the dataset in a folder. `config_toml` is text in the format of config.toml; NULL or empty:
// the settings follow from the photographs. `watch` follows this call and the training; NULL: none. The device must
// not be record-only.
NspResult nsp_trainer_create(struct NspDevice *device,
                             const char *dataset,
                             const char *config_toml,
                             const struct NspWatch *watch,
                             struct NspTrainer **trainer);

// Trains for about `milliseconds`, up to step `until` at most; 0 stands for 500. Writes the last of these steps to
// `steps`, at most `*count`, and their number to `*count`; both may be NULL. There may be no step: held-out views are
// scored in calls of their own, `until` is reached, or the training has ended.
NspResult nsp_trainer_advance(struct NspTrainer *trainer,
                              uint64_t until,
                              uint32_t milliseconds,
                              struct NspStep *steps,
                              uint32_t *count);

// Whether the last step is done and scored: 1; else 0.
uint32_t nsp_trainer_has_ended(const struct NspTrainer *trainer);

// Writes the last scores of the held-out views to `scores`, at most `*count`, and their number to `*count`.
NspResult nsp_trainer_scores(const struct NspTrainer *trainer, struct NspScore *scores, uint32_t *count);

// Copies the current model, on the trainer's device.
NspResult nsp_trainer_model(struct NspTrainer *trainer, struct NspModel **model);

// Writes a checkpoint of the training, from which `nightsplat train --resume` goes on, if a run directory has it.
NspResult nsp_trainer_checkpoint(struct NspTrainer *trainer, const char *path);

// Saves the current model in the format of the path's extension: `.ply`, `.spz`, `.sog` or `.glb`.
NspResult nsp_trainer_save(struct NspTrainer *trainer, const char *path);

// Destroys a trainer; waits for its submissions.
void nsp_trainer_destroy(struct NspTrainer *trainer);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* NIGHTSPLAT_H */
